"""Opens the pilot in the background, so that the node publishes safe actions until the server answers."""

import dataclasses
import logging
import threading
from collections.abc import Callable

import spikeserve

from spikeserve_ros.acting import Task
from spikeserve_ros.errors import ValueRefusedError
from spikeserve_ros.mapping import RobotMapping
from spikeserve_ros.parameters import Settings

LOGGER = logging.getLogger("spikeserve_ros")
RETRY_SECONDS = 1.0


def task_of(client: spikeserve.Client, settings: Settings) -> Task:
    """Returns the sizes and the target return of the policy. Raises ValueRefusedError if the server does not serve it."""
    served = client.list_policies()
    for policy in served:
        wanted = policy.is_default if settings.version == 0 else policy.version == settings.version
        if policy.name == settings.policy and wanted:
            space = policy.action_space
            names = tuple(feature.name for feature in policy.observation_features)
            if isinstance(space, spikeserve.Discrete):
                return Task(policy.observation_size, int(space.n), 1, names, policy.target_return)
            return Task(policy.observation_size, None, len(space.low), names, policy.target_return)
    names = sorted({f"{policy.name}/{policy.version}" for policy in served})
    raise ValueRefusedError(
        "policy", "one of " + ", ".join(names), f"{settings.policy}/{settings.version or 'default'}"
    )


class Connecting:
    """Tries to open a pilot until it succeeds. `take` and `error` may be called from any thread.

    `target_return` returns that of the first episode, None: that of the policy file. A thread of this class calls it.
    """

    def __init__(
        self, settings: Settings, mapping: RobotMapping, target_return: Callable[[], float | None]
    ) -> None:
        self._settings = settings
        self._mapping = mapping
        self._target_return = target_return
        self._lock = threading.Lock()
        self._opened: tuple[spikeserve.Pilot, Task] | None = None
        self._error = "the server has not answered yet"
        self._stop = threading.Event()
        self._closers: list[Callable[[], None]] = []
        self._thread = threading.Thread(target=self._run, name="connecting", daemon=True)
        self._thread.start()

    @property
    def error(self) -> str:
        """Returns why there is no pilot yet; empty if there is one."""
        with self._lock:
            return self._error

    def take(self) -> tuple[spikeserve.Pilot, Task] | None:
        """Returns the pilot and the sizes of its policy, once; None: not yet, or not again."""
        with self._lock:
            opened, self._opened = self._opened, None
            return opened

    def close(self) -> None:
        """Ends the tries, and closes the pilot and its connection. The pilot tells the server the rest first."""
        self._stop.set()
        self._thread.join()
        for close in reversed(self._closers):
            close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._open()
                return
            except (spikeserve.SpikeserveError, ValueRefusedError, ValueError, ImportError) as error:
                with self._lock:
                    changed, self._error = self._error != str(error), str(error)
                if changed:
                    LOGGER.error("no pilot yet: %s", error)
            self._stop.wait(RETRY_SECONDS)

    def _open(self) -> None:
        settings = self._settings
        client = spikeserve.Client(settings.server)
        try:
            task = task_of(client, settings)
            mapping = task.mapped(self._mapping, settings)
            task.check(mapping, settings)
            target = self._target_return()
            if target is None:  # traffic shares may choose another version, whose own target the session then has
                task = dataclasses.replace(task, target_return=None)
            session = spikeserve.SessionOptions(
                version=settings.version, target_return=target, observation=mapping.names
            )
            neutral = list(settings.safe_action) if task.actions is None else None
            way = {"transport": settings.transport, "redundancy": settings.redundancy}
            pilot = spikeserve.Pilot(
                client, settings.policy, period=settings.period, neutral=neutral, session=session, **way
            )
        except BaseException:
            client.close()
            raise
        with self._lock:
            self._closers += [client.close, pilot.close]
            self._opened, self._error = (pilot, task), ""
