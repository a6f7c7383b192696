"""Maps between the spaces of an environment and those of a policy.

A policy reads one vector of float32 numbers, and chooses an index or a vector within bounds. The
mappings are the same wherever a policy is trained, evaluated or played: `spiketrain` maps the
actions of Minari files in the same way.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from spikeserve.check import check, unmasked

LARGEST_JOINT_SPACE = 4096  # the outputs of an action head
LARGEST_OBSERVATION = 1 << 20  # numbers; as in `spiketrain train --data`
_OBSERVATIONS = "Box, Discrete, MultiDiscrete, MultiBinary, or Dict or Tuple of these"
_ACTIONS = "Discrete, MultiDiscrete, MultiBinary or Box"


class ObservationMap:
    """Flattens observations by `gymnasium.spaces.flatten`, as FlattenObservation does.

    ValueError for a space that has no fixed number of elements, such as Sequence or Text, and for
    one that is too large.
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        _check_observations(space, "observation_space")
        self._space = space
        self.size = spaces.flatdim(space)
        check(self.size >= 1, "observation_space", "at least one element", space)
        at_most = f"at most {LARGEST_OBSERVATION} numbers"
        check(self.size <= LARGEST_OBSERVATION, "observation_space", at_most, self.size)
        # The type in which observations are recorded: images take a quarter of float32.
        self.stored_dtype = np.dtype(np.uint8 if space.dtype == np.uint8 else np.float32)

    def flatten(self, observation: Any) -> NDArray[np.float32]:
        """Returns the observation as float32 [size]. ValueError for masked numbers."""
        _check_unmasked(observation, "observation")
        return np.asarray(spaces.flatten(self._space, observation), np.float32).reshape(self.size)


def _check_unmasked(observation: Any, name: str) -> None:
    if isinstance(observation, dict | tuple):
        parts = observation.items() if isinstance(observation, dict) else enumerate(observation)
        for key, part in parts:
            _check_unmasked(part, f"{name}[{key!r}]")
        return
    unmasked(observation, name)


def _check_observations(space: spaces.Space[Any], name: str) -> None:
    """ValueError, with the place in a Dict or Tuple, for a part that is not a vector of numbers."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        for key, part in parts:
            _check_observations(part, f"{name}[{key!r}]")
        return
    leaf = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
    expected = _OBSERVATIONS
    if name != "observation_space":
        expected += "; a wrapper such as gymnasium.wrappers.FilterObservation removes it"
    check(isinstance(space, leaf), name, expected, space)


def element_names(space: spaces.Space[Any]) -> tuple[str, ...]:
    """Returns a name for each number of a flattened Dict, such as "arm[0]".

    () for other spaces, and where two names are equal: of "a/b", and of "b" in "a".
    """
    names = tuple(_element_names(space, "")) if isinstance(space, spaces.Dict) else ()
    return names if len(set(names)) == len(names) else ()


def _element_names(space: spaces.Space[Any], name: str) -> list[str]:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        prefix = f"{name}/" if name else ""
        return [n for key, part in parts for n in _element_names(part, f"{prefix}{key}")]
    size = spaces.flatdim(space)
    return [name] if size == 1 else [f"{name}[{index}]" for index in range(size)]


class ActionMap:
    """Maps actions to those of a policy: `space` is a Discrete from 0 or a Box of one dimension.

    A MultiDiscrete or MultiBinary becomes one index of all combinations, in which the last element
    changes fastest. ValueError for other spaces, for a Box without finite bounds, and for too many
    combinations.
    """

    def __init__(self, native: spaces.Space[Any]) -> None:
        self._native = native
        self.space: spaces.Discrete | spaces.Box
        if isinstance(native, spaces.Box):
            with np.errstate(over="ignore"):  # a bound that float32 cannot hold is infinite
                low, high = (np.asarray(b, np.float32).ravel() for b in (native.low, native.high))
            bounded = bool(np.isfinite(low).all() and np.isfinite(high).all())
            check(bounded, "action_space", "finite bounds in float32", native)
            check(bool(np.all(low < high)), "action_space", "lower bounds below the upper", native)
            self.space = spaces.Box(low, high, dtype=np.float32)
            return
        self._start, self._lengths = _index_ranges(native)
        joint = int(np.prod(self._lengths, dtype=object))
        check(
            joint <= LARGEST_JOINT_SPACE,
            "action_space",
            f"at most {LARGEST_JOINT_SPACE} combinations",
            joint,
        )
        self.space = spaces.Discrete(joint)

    def to_native(self, action: Any) -> Any:
        """Converts an action of `space` to one of the environment, which its space contains."""
        if isinstance(self._native, spaces.Box):
            return to_native_box(action, self._native)
        if isinstance(self._native, spaces.Discrete):
            return int(action) + int(self._native.start)
        indices = np.array(np.unravel_index(int(action), self._lengths)) + self._start
        return indices.reshape(self._native.shape).astype(self._native.dtype)

    def to_flat(self, action: Any) -> int | NDArray[np.float32]:
        """Converts an action of the environment to one of `space`. Clips values to the bounds."""
        if isinstance(self.space, spaces.Box):
            values = np.asarray(unmasked(action, "action"), np.float32).ravel()
            check(
                values.shape == self.space.shape,
                "action",
                f"shape {self.space.shape}",
                values.shape,
            )
            return np.clip(values, self.space.low, self.space.high)
        indices = np.asarray(action, np.int64).ravel() - self._start
        in_range = indices.shape == self._lengths.shape and bool(
            np.all(indices >= 0) and np.all(indices < self._lengths)
        )
        check(in_range, "action", f"one of {self._native}", action)
        return int(np.ravel_multi_index(tuple(indices), tuple(self._lengths)))

    def sample(self, random: np.random.Generator) -> int | NDArray[np.float32]:
        """Draws an action of `space` uniformly."""
        if isinstance(self.space, spaces.Discrete):
            return int(random.integers(self.space.n))
        return random.uniform(self.space.low, self.space.high).astype(np.float32)


def to_native_box(action: Any, native: spaces.Box) -> NDArray[Any]:
    """Converts values within the float32 bounds of a Box to values that the Box contains.

    The bounds of a policy are float32 numbers. They become exactly the bounds of `native`, which
    may lie beside them: 0.1, or 2^31 - 1.
    """
    values = np.asarray(action, np.float32).reshape(native.shape)
    low, high = (np.asarray(bound, np.float32) for bound in (native.low, native.high))
    inside = (values > low) & (values < high)
    rounded = np.where(inside, values, 0)
    if np.issubdtype(native.dtype, np.integer):
        rounded = np.rint(rounded)
    at_bound = np.where(values >= high, native.high, native.low)
    result: NDArray[Any] = np.where(inside, rounded.astype(native.dtype), at_bound)
    return result.astype(native.dtype)


def _index_ranges(native: spaces.Space[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns the first index and the number of indices of each element of an action."""
    if isinstance(native, spaces.Discrete):
        return np.array([native.start], np.int64), np.array([native.n], np.int64)
    if isinstance(native, spaces.MultiDiscrete):
        return np.ravel(native.start).astype(np.int64), np.ravel(native.nvec).astype(np.int64)
    if isinstance(native, spaces.MultiBinary):
        size = int(np.prod(native.shape))
        return np.zeros(size, np.int64), np.full(size, 2, np.int64)
    raise ValueError(f"action_space: expected {_ACTIONS}, received {native}")


class FlatEnvironment(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gives an environment the spaces of a policy.

    `native_space` is its own observation space, and `native_observation` the last observation.
    """

    def __init__(self, environment: Any) -> None:
        super().__init__(environment)
        self.native_space: spaces.Space[Any] = environment.observation_space
        self.observations = ObservationMap(environment.observation_space)
        self.actions = ActionMap(environment.action_space)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.observations.size,), np.float32)
        self.action_space = self.actions.space
        self.native_observation: Any = None

    def reset(self, **arguments: Any) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Resets the environment. Returns the flat observation and the infos."""
        self.native_observation, infos = self.env.reset(**arguments)
        return self.observations.flatten(self.native_observation), infos

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Steps with an action of the flat space. Returns the flat observation and the rest."""
        native = self.actions.to_native(action)
        self.native_observation, reward, terminated, truncated, infos = self.env.step(native)
        flat = self.observations.flatten(self.native_observation)
        return flat, float(reward), bool(terminated), bool(truncated), infos
