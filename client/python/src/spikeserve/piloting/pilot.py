"""`Pilot`: every beat of a robot has an action, whatever the link does."""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.connection import Connection
from spikeserve.executed import source_of
from spikeserve.piloting import robot_clock
from spikeserve.piloting.datagram_link import require_ciphers
from spikeserve.piloting.link import Link
from spikeserve.piloting.pilot_options import PilotAction, PilotOptions
from spikeserve.piloting.pilot_stats import PilotStats
from spikeserve.piloting.robot_messages import (
    from_robot,
    lost_episode,
    number_of,
    observation_of,
    require_robot,
    robot,
    to_robot,
)
from spikeserve.piloting.server_session import ServerSession, nanoseconds
from spikeserve.stream_opener import StreamOpener
from spikeserve.trace_context import active_traceparent
from spikeserve.values import EpisodeSummary, ExecutedLike

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

LOGGER = logging.getLogger("spikeserve.pilot")
ASK_AGAIN_SECONDS = 0.05


class Pilot:
    """Flies one robot: returns an action for each beat in time, fresh from the server if possible.

        with Client(address) as client, Pilot(client, "pendulum", period=0.02) as pilot:
            action = pilot.beat(observation, reward)

    The further arguments are the fields of PilotOptions. The constructor opens the session and
    waits for the server, and raises SpikeserveError, or ImportError if the package was installed
    without its compiled part, or the transport "datagram" without `cryptography`; `beat` never
    waits longer than the budget, and raises only before its first valid observation. A background
    thread brings the server all beats, in order and once, whoever chose their actions: the server's
    session is that of the robot.
    Answers that come too late are not executed, and neither are those from before a reconnection.

    For one thread; `stats` may be called from any.
    """

    def __init__(self, client: Connection, policy: str, period: float, **options: Any) -> None:
        require_robot()
        self._options = PilotOptions(period=period, **options)
        if self._options.transport == "datagram":
            require_ciphers()
        opener = StreamOpener(client)
        self._session = ServerSession(client, policy, self._options, opener.route)
        try:
            self._link = Link(client, self._options, opener, self._session)
        except BaseException:
            self._session.close()
            raise
        self._machine = self._link.machine
        self._order = self._session.order
        self._space = self._session.opening.action_space
        self._size = self._session.opening.observation_size
        self._no_observation = np.full(self._size, np.nan, np.float32)
        self._wait = nanoseconds(self._options.wait)
        self._fallback = self._options.fallback and self._order.around(self._options.fallback)
        self._wrong = ""  # the last observation that was no row of numbers
        self._beats = 0
        self._has_failed = False
        self._link.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def session_id(self) -> str:
        """Returns the id of the session at the server."""
        return self._session.session_id

    def beat(
        self,
        observation: ArrayLike,
        reward: float = 0.0,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> PilotAction:
        """Returns the action for an observation, at most `budget` seconds later.

        `reward` is for the action of the beat before; the first beat of an episode ignores it.
        `executed_action` is what the robot executed in the beat before, if it differs from the
        returned action, for example because a safety layer clipped it; `Executed` says who chose
        it.

        Raises ValueError as long as no observation was valid: the robot is not wired right. Later,
        a beat whose observation has another size, or a number that is not finite, has a held or a
        safe action, and nothing raises.
        """
        began, robot_now = time.monotonic_ns(), robot_clock.now_ns()
        deadline = began + self._wait
        seen, wrong = observation_of(observation, self._size, self._order)
        executed = to_robot(executed_action, self._space, self._order)
        source = source_of(executed_action)
        traceparent, earned = active_traceparent(), number_of(reward)
        machine, changed = self._machine, self._link.changed
        with changed:
            step = seen, earned, executed, source, traceparent
            if not machine.begin_step(*step, began, robot_now):
                raise ValueError(wrong or machine.invalid_observation())
            sees = machine.sees()
            if not sees:
                self._wrong = wrong
            self._link.send()
            while True:
                now = time.monotonic_ns()
                choice = machine.choose(now, robot_clock.now_ns(), deadline)
                if choice is not robot.Choice.WAIT:
                    break
                changed.wait((deadline - now) / 1e9)
            if choice is robot.Choice.TAKEN:
                return self._finish()
        own = self._own_action(seen if sees else self._no_observation)
        with changed:
            machine.take_own(own)
            return self._finish()

    def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> Future[EpisodeSummary]:
        """Ends the episode; the next beat begins another one. Never waits, and never raises.

        The arguments are those of Session.end_episode. The result of the future is the summary of
        the server, once it has all beats of the episode. Its exception is SpikeserveError if the
        session was lost, or the pilot closed before.
        """
        summary: Future[EpisodeSummary] = Future()
        summary.set_running_or_notify_cancel()  # it cannot be cancelled
        last = None
        if observation is not None:
            last, wrong = observation_of(observation, self._size, self._order)
            last = self._no_observation if wrong else last
        target = None if target_return is None else number_of(target_return)
        executed = to_robot(executed_action, self._space, self._order)
        ending = number_of(reward), bool(terminated), bool(truncated), target, last, executed
        source = source_of(executed_action)
        with self._link.changed:
            steps, lost_steps = self._machine.running_steps(), self._machine.lost_steps()
            serial = self._machine.end_episode(*ending, source)
            if serial is not None:
                self._link.await_end(serial, summary)
            elif steps > 0:
                summary.set_exception(lost_episode("the pilot was closed"))
            else:
                summary.set_result(EpisodeSummary(0.0, 0, 0, 0.0, lost_steps=lost_steps))
        return summary

    def wait_ready(self, timeout: float) -> bool:
        """Waits for an answer that the next beat may execute, for at most `timeout` seconds.

        Returns whether there is one. The first beats of an episode have none on a slow link; a
        robot that stands still calls this after its first beat. An answer that is older than
        `max_age` then is not executed all the same.
        """
        link, ends = self._link, time.monotonic() + timeout
        with link.changed:
            while not self._machine.has_answer():
                left = ends - time.monotonic()
                if left <= 0:
                    return False
                # No beat asks meanwhile: the stream may have opened, or broken, after the last one.
                self._machine.ask_again(time.monotonic_ns(), robot_clock.now_ns())
                link.send()
                link.changed.wait(min(left, ASK_AGAIN_SECONDS))
        return True

    def stats(self) -> PilotStats:
        """Returns what the pilot has done so far."""
        with self._link.changed:
            stats = self._machine.stats(time.monotonic_ns())
        if self._wrong:
            stats["last_invalid_observation"] = self._wrong
        return PilotStats(**stats)

    def close(self) -> None:
        """Waits until the server has the ends of all episodes, then closes the session.

        Waits for at most `close_timeout` seconds. Futures of episodes whose end the server does not
        have then fail.
        """
        self._link.close(self._options.close_timeout)

    def _own_action(self, observation: NDArray[np.float32]) -> Any:
        """Returns the action of the robot's own function; an invalid one if that has failed."""
        if self._fallback is None:
            return self._session.neutral
        try:
            return to_robot(self._fallback(observation), self._space)
        except Exception:
            if not self._has_failed:
                LOGGER.exception("the fall-back of the robot failed; the neutral action is taken")
            self._has_failed = True
            return None

    def _finish(self) -> PilotAction:
        given, source, age = self._machine.finish_step(time.monotonic_ns(), robot_clock.now_ns())
        self._beats += 1
        return PilotAction(self._order.action(from_robot(given)), source, age, self._beats - 1)
