"""Chooses what the node publishes at each beat.

    acting = Acting(mapping, settings, time.monotonic)
    acting.begin(pilot, task)
    acting.observe(lambda: [0.0, 0.1, 0.0, 0.0])
    acting.reward(1.0)
    step = acting.beat()  # step.command is what the actuators get

Not thread-safe: the node calls it from one thread.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from spikeserve_ros.errors import ValueRefusedError
from spikeserve_ros.mapping import Joints, RobotMapping, check_finite, elements_of, vector
from spikeserve_ros.parameters import Settings

# No pilot yet, or no recent observation. The other sources are those of spikeserve.Pilot.
LOST = "lost"
SOURCES = ("fresh", "held", "local", "safe", LOST)


class Pilot(Protocol):
    """What the node needs of spikeserve.Pilot."""

    def beat(self, observation: Sequence[float], reward: float) -> Any:
        """Returns an object with `action`, `source` and `age`, within the period, whatever the server does."""

    def end_episode(self, reward: float, **options: Any) -> Any:
        """Ends the episode; the next beat begins another one. Does not wait."""

    def stats(self) -> Any:
        """Returns a dataclass of counts."""


@dataclasses.dataclass(frozen=True)
class Task:
    """The sizes of a policy."""

    observation_size: int
    actions: int | None  # the number of discrete actions; None: an action is a vector
    action_size: int  # of such a vector
    names: tuple[str, ...] = ()  # of the elements of an observation; (): the policy has none
    target_return: float | None = None  # of the policy file; None: the session aims at it unless told otherwise

    def mapped(self, mapping: RobotMapping, settings: Settings) -> RobotMapping:
        """Returns the mapping, with the elements that the policy's names mean if it has none and the input is joints.

        Raises ValueRefusedError if there are no such names.
        """
        if settings.input != "joints" or mapping.elements:
            return mapping
        if not self.names:
            raise ValueRefusedError("mapping", "a file, because the policy names no elements", settings.mapping)
        return dataclasses.replace(mapping, elements=elements_of(self.names))

    def check(self, mapping: RobotMapping, settings: Settings) -> None:
        """Raises ValueRefusedError, which names the parameter or the field of the mapping that does not fit."""
        if mapping.elements and len(mapping.elements) != self.observation_size:
            raise ValueRefusedError("observation", f"{self.observation_size} elements", len(mapping.elements))
        size = self.action_size
        if mapping.actions:
            if len(mapping.actions) != self.actions:
                raise ValueRefusedError("actions", f"{self.actions or 'no'} vectors", len(mapping.actions))
            size = len(mapping.actions[0])
        if len(settings.safe_action) != size:
            raise ValueRefusedError("safe_action", f"{size} numbers", list(settings.safe_action))


@dataclasses.dataclass(frozen=True)
class Step:
    """What is published at a beat."""

    command: list[float]
    source: str  # one of SOURCES
    age: float  # seconds since the observation that the action was chosen for; 0: there is none


class Acting:
    """See the module. Publishes the safe action until it has a pilot and an observation."""

    def __init__(self, mapping: RobotMapping, settings: Settings, clock: Callable[[], float]) -> None:
        self._mapping = mapping
        self._settings = settings
        self._clock = clock
        self._pilot: Pilot | None = None
        self._task: Task | None = None
        self._observation: list[float] | None = None
        self._observed_at = 0.0
        self._joints = Joints()
        self._reward = 0.0
        self.target_return = settings.target_return  # of the next episode; None: that of the policy file
        self.beats = dict.fromkeys(SOURCES, 0)
        self.refusal = ""  # why the last message was refused; the node clears it

    @property
    def stats(self) -> dict[str, Any]:
        """Returns what the pilot has counted."""
        if self._pilot is None:
            return {}
        return {name: value for name, value in dataclasses.asdict(self._pilot.stats()).items() if name != "entries"}

    def begin(self, pilot: Pilot, task: Task) -> None:
        """Acts by a pilot from now on."""
        self._pilot, self._task, self._observation = pilot, task, None
        self._mapping = task.mapped(self._mapping, self._settings)

    def observe_vector(self, values: Sequence[float]) -> None:
        """Keeps an observation. Refuses one of another size, or with values that are not finite."""
        size = self._task.observation_size if self._task else len(values)
        self._observe(lambda: (vector("observation", values, size), self._clock()))

    def observe_joints(self, names: Sequence[str], fields: dict[str, Sequence[float]]) -> None:
        """Keeps the observation that the mapping makes of the last numbers of all joints.

        It is as old as the oldest of them. Refuses numbers that do not fit the names, and names the joint that lacks.
        """

        def make() -> tuple[list[float], float]:
            now = self._clock()
            self._joints.update(names, fields, now)
            return self._mapping.observation(self._joints), now - self._mapping.age(self._joints, now)

        self._observe(make)

    def _observe(self, make: Callable[[], tuple[list[float], float]]) -> None:
        try:
            self._observation, self._observed_at = make()
        except ValueRefusedError as error:  # the former observation grows older
            self.refusal = str(error)

    def reward(self, value: float) -> None:
        """Adds a reward, which the next beat reports. Refuses one that is not finite."""
        try:
            [value] = check_finite("reward", [value])
        except ValueRefusedError as error:
            self.refusal = str(error)
            return
        self._reward += value

    def beat(self) -> Step:
        """Returns the action of this beat."""
        step = self._decide()
        self.beats[step.source] += 1
        return step

    def _decide(self) -> Step:
        safe = list(self._settings.safe_action)
        if self._pilot is None or self._observation is None:
            return Step(safe, LOST, 0.0)
        age = self._clock() - self._observed_at
        if age > self._settings.observation_timeout:
            return Step(safe, LOST, age)
        reward, self._reward = self._reward, 0.0
        chosen = self._pilot.beat(self._observation, reward)
        # The pilot's own safe action leads a vector smoothly to safe_action, its neutral one. Discrete actions have none.
        if chosen.source == "safe" and self._task.actions is not None:
            return Step(safe, "safe", chosen.age)
        return Step(self._mapping.command(chosen.action), chosen.source, chosen.age)

    def end_episode(self, terminated: bool) -> None:
        """Ends the episode, by the task or by an operator. Rewards and observations of it do not count for the next one."""
        if self._pilot is not None:
            reward = self._reward
            target = self._task.target_return if self.target_return is None else self.target_return
            self._pilot.end_episode(reward, terminated=terminated, truncated=not terminated, target_return=target)
        self._observation = None
        self._joints = Joints()
        self._reward = 0.0
