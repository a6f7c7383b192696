"""Episodes of a robot, as every format is read into and written from.

Plain values. Thread-safe on distinct data.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.spaces import ActionSpace, Box, Discrete

LARGEST_OBSERVATION = 1 << 20  # numbers; as in `spiketrain train --data`
LARGEST_DISCRETE = 4096  # actions; as in `spiketrain train --data`
LARGEST_NUMBER = 1e18  # of an observation, a reward or a weight; as in `spiketrain train --data`
LONGEST_NAME = 256  # bytes, of an element; as in policy files
# Numbers outside of their bounds by this part of the range are rounded, as in `spiketrain`.
ROUNDING = 1e-6
# Who chose an executed action; an operator may have a name behind a colon.
SOURCES = ("unknown", "policy", "operator", "safety_layer", "held", "local", "safe", "hold")


@dataclass
class Episode:
    """One episode of T steps."""

    observations: NDArray[np.float32]  # [T + 1, obs]; the last row is NaN if it is unknown
    actions: NDArray[Any]  # as executed: int64 [T], or float32 [T, size] of a Box
    rewards: NDArray[np.float64]  # [T]
    terminated: bool = False
    truncated: bool = True
    seed: int = 0
    actor: str = "unknown"
    task: str = ""
    labels: NDArray[Any] | None = None  # actions to imitate, like `actions`; None: the actions
    weights: NDArray[np.float32] | None = None  # [T], of the labels in the loss; None: all 1
    asked_return: float | None = None  # return that the actor was asked to reach
    # What a server added to its recording: the fields of `served` in docs/guides/recording.md.
    served: Mapping[str, Any] | None = None

    @property
    def steps(self) -> int:
        """Returns the number of actions."""
        return len(self.actions)

    @property
    def has_last_observation(self) -> bool:
        """Returns whether the observation after the last action is known."""
        return bool(np.isfinite(self.observations[-1]).all())


@dataclass
class RobotData:
    """Episodes of one environment or robot. They are in memory."""

    environment: str
    action_space: ActionSpace
    episodes: list[Episode]
    fps: float | None = None  # steps a second; None: unknown
    observation_names: tuple[str, ...] = ()  # of the elements; empty: unknown
    action_names: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)  # what the reader decided or left out

    @property
    def observation_size(self) -> int:
        """Returns the number of elements of an observation."""
        return int(self.episodes[0].observations.shape[1])

    @property
    def steps(self) -> int:
        """Returns the number of actions of all episodes."""
        return sum(episode.steps for episode in self.episodes)


@dataclass(frozen=True)
class Selection:
    """What to read from formats that do not show which numbers are an observation or an action.

    None or an empty value selects what the format declares.
    """

    observation: tuple[str, ...] = ()  # columns of LeRobot or topics of MCAP, concatenated
    action: str = ""
    reward: str = ""
    actions: int | None = None  # number of discrete actions
    action_low: tuple[float, ...] = ()  # bounds of a continuous action, one or one an element
    action_high: tuple[float, ...] = ()
    environment: str = ""
    fps: float | None = None
    task: str = ""

    @property
    def has_bounds(self) -> bool:
        """Returns whether a bound of the action is given."""
        return bool(self.action_low or self.action_high)


def check_episode(data: RobotData, episode: Episode, where: str) -> None:
    """ValueError, which names `where`, the array and the step, for an episode that is not valid.

    Rounds actions and labels to the bounds where only rounding has left them outside.
    """
    steps = episode.steps
    check(steps >= 1, f"{where}: actions", "at least one", "none")
    size = (steps + 1, data.observation_size)
    shape = episode.observations.shape
    check(shape == size, f"{where}: observations", f"shape {size}", shape)
    shape = episode.rewards.shape
    check(shape == (steps,), f"{where}: rewards", f"shape {(steps,)}", shape)
    known = episode.observations if episode.has_last_observation else episode.observations[:-1]
    _check_finite(known, f"{where}: observations")
    last = episode.observations[-1]
    complete = episode.has_last_observation or bool(np.isnan(last).all())
    expected = "finite numbers, or NaN for all of them"
    check(complete, f"{where}: observations: step {steps}", expected, last.tolist())
    _check_finite(episode.rewards, f"{where}: rewards")
    for name, actions in (("actions", episode.actions), ("labels", episode.labels)):
        if actions is not None:
            _check_actions(data.action_space, actions, steps, f"{where}: {name}")
    if episode.weights is not None:
        received = episode.weights.shape
        check(received == (steps,), f"{where}: weights", f"shape {(steps,)}", received)
        _check_finite(episode.weights, f"{where}: weights")
        for step in np.flatnonzero(episode.weights < 0)[:1]:
            expected = "a number of at least 0"
            check(False, f"{where}: weights: step {step}", expected, episode.weights[step])
    asked = episode.asked_return
    valid = asked is None or abs(asked) <= LARGEST_NUMBER
    check(valid, f"{where}: asked_return", "a finite number", asked)
    actor = episode.actor
    check(actor.isprintable(), f"{where}: actor", "printable characters", repr(actor))
    check(0 <= episode.seed < 1 << 64, f"{where}: seed", "0 to 2^64 - 1", episode.seed)
    if episode.served is not None:
        _check_served(episode.served, steps, f"{where}: served")


def sources_of(episode: Episode) -> list[str]:
    """Returns who chose each executed action of a served episode, as its recording says it.

    A recording that does not say it has actions of the policy, where they are the answered ones.
    """
    assert episode.served is not None
    sources = episode.served.get("sources")
    if sources is not None:
        return list(sources)
    answered = episode.served.get("answered_actions", episode.actions)
    equal = [np.array_equal(*both) for both in zip(episode.actions, answered, strict=True)]
    return ["policy" if is_answer else "unknown" for is_answer in equal]


def _check_served(served: Mapping[str, Any], steps: int, where: str) -> None:
    """ValueError unless a record has what the converters write of it."""

    def integer(value: Any) -> bool:
        return type(value) is int and 0 <= value < 1 << 63

    def number(value: Any) -> bool:
        return type(value) in (int, float) and abs(value) <= LARGEST_NUMBER

    for key in ("policy", "version", "returns_to_go", "spikes"):
        check(key in served, f"{where}.{key}", "a value", "none")
    policy, version = served["policy"], served["version"]
    check(isinstance(policy, str), f"{where}.policy", "a text", type(policy).__name__)
    check(integer(version), f"{where}.version", "an integer", version)
    for key, holds, of_what in (
        ("returns_to_go", number, f"a finite number of at most {LARGEST_NUMBER:g}"),
        ("spikes", integer, "an integer of at least 0"),
    ):
        values = served[key]
        whole = isinstance(values, list) and len(values) == steps
        check(whole, f"{where}.{key}", f"a list of {steps}", np.shape(values))
        for step, value in enumerate(values):
            check(holds(value), f"{where}.{key}: step {step}", of_what, value)
    for key in {"sources", "answered_actions"} & served.keys():
        values = served[key]
        whole = isinstance(values, list) and len(values) == steps
        check(whole, f"{where}.{key}", f"a list of {steps}", np.shape(values))
    for step, source in enumerate(served.get("sources", [])):
        known = isinstance(source, str) and source.partition(":")[0] in SOURCES
        check(known, f"{where}.sources: step {step}", f"one of {SOURCES}", repr(source))


def _check_finite(values: NDArray[Any], where: str) -> None:
    with np.errstate(invalid="ignore"):
        bad = np.argwhere(~(np.abs(values) <= LARGEST_NUMBER))
    if len(bad):
        at = ", element ".join(str(index) for index in bad[0])
        value = values[tuple(bad[0])]
        huge = f" of at most {LARGEST_NUMBER:g}" if np.isfinite(value) else ""
        check(False, f"{where}: step {at}", f"a finite number{huge}", value)


def _check_actions(space: ActionSpace, actions: NDArray[Any], steps: int, where: str) -> None:
    if isinstance(space, Discrete):
        check(actions.shape == (steps,), where, f"shape {(steps,)}", actions.shape)
        bad = np.flatnonzero((actions < 0) | (actions >= space.n))
        if len(bad):
            expected = f"an index in [0, {space.n})"
            check(False, f"{where}: step {bad[0]}", expected, actions[bad[0]])
        return
    expected_shape = (steps, len(space.low))
    check(actions.shape == expected_shape, where, f"shape {expected_shape}", actions.shape)
    _check_finite(actions, where)
    low, high = (np.asarray(bound, np.float32) for bound in (space.low, space.high))
    slack = ROUNDING * (high.astype(np.float64) - low)
    outside = np.argwhere((actions < low - slack) | (actions > high + slack))
    if len(outside):
        step, element = outside[0]
        bounds = f"a number in [{space.low[element]:g}, {space.high[element]:g}]"
        where = f"{where}: step {step}, element {element}"
        check(False, where, bounds, actions[step, element])
    np.clip(actions, low, high, out=actions)


def action_space_of(
    actions: list[NDArray[Any]], selection: Selection, where: str
) -> tuple[ActionSpace, list[NDArray[Any]], list[str]]:
    """Returns the action space of recorded actions, the actions in its form, and notes.

    Each array is [T, size]. Integers of one element are Discrete; everything else is a Box. Bounds
    that `selection` does not give are the smallest and largest recorded values.
    """
    integers = all(np.issubdtype(a.dtype, np.integer) and a.shape[1] == 1 for a in actions)
    if selection.actions is not None or (integers and not selection.has_bounds):
        whole = integers or all(a.shape[1] == 1 and bool((a == np.rint(a)).all()) for a in actions)
        check(whole, where, "one integer a step, because of --actions", "other numbers")
        indices = [a[:, 0].astype(np.int64) for a in actions]
        largest = max(int(a.max()) for a in indices)
        given = selection.actions
        space = Discrete(max(2, largest + 1) if given is None else given)
        in_range = 2 <= space.n <= LARGEST_DISCRETE
        check(in_range, where, f"2 to {LARGEST_DISCRETE} discrete actions", space.n)
        guessed = f"{where}: {space.n} discrete actions, by the largest index; --actions gives it"
        return space, indices, [guessed] if given is None else []
    values = [a.astype(np.float32) for a in actions]
    for index, array in enumerate(values):
        _check_finite(array, f"{where}: episode {index}")
    notes = []
    size = values[0].shape[1]
    low = _bounds(selection.action_low, size, "--action-low")
    high = _bounds(selection.action_high, size, "--action-high")
    if low is None or high is None:
        notes.append(
            f"{where}: missing bounds are the smallest and largest recorded values; "
            "--action-low and --action-high give them"
        )
    low = np.min([a.min(axis=0) for a in values], axis=0) if low is None else low
    high = np.max([a.max(axis=0) for a in values], axis=0) if high is None else high
    for element in np.flatnonzero(low >= high):
        name = f"{where}: element {element}"
        expected = "values that differ, or --action-low below --action-high"
        check(False, name, expected, f"bounds {low[element]:g} and {high[element]:g}")
    return Box(tuple(low.tolist()), tuple(high.tolist())), values, notes


def _bounds(bounds: tuple[float, ...], size: int, flag: str) -> NDArray[np.float32] | None:
    if not bounds:
        return None
    check(len(bounds) in (1, size), flag, f"1 or {size} numbers", len(bounds))
    check(bool(np.isfinite(bounds).all()), flag, "finite numbers", bounds)
    return np.broadcast_to(np.asarray(bounds, np.float32), (size,)).copy()


def fingerprint(episode: Episode) -> int:
    """Returns a number by which an episode is recognised: of its observations and actions."""
    rows = np.ascontiguousarray(episode.observations[:-1], np.float32)
    return zlib.crc32(np.asarray(episode.actions, np.float64).tobytes(), zlib.crc32(rows.tobytes()))


def environment_name(selection: Selection, default: str) -> str:
    """Returns the name of an environment, with the characters that Gymnasium allows in an id."""
    if selection.environment:
        allowed = re.fullmatch(r"([\w:-]+/)?[\w:.-]+", selection.environment) is not None
        check(allowed, "--env", "an id of Gymnasium, such as Name-v0", selection.environment)
        return selection.environment
    return re.sub(r"[^\w.-]+", "-", default).strip("-.") or "robot"


def names_to_json(data: RobotData) -> dict[str, list[str]]:
    """Returns the names that are known, as `recipe` of the files of spiketrain has them."""
    names = {"observation_names": data.observation_names, "action_names": data.action_names}
    return {key: list(value) for key, value in names.items() if value}


def read_names(data: RobotData, stored: Any) -> None:
    """Reads what names_to_json() returns."""
    for key in ("observation_names", "action_names"):
        names = stored.get(key) if isinstance(stored, dict) else None
        if isinstance(names, list) and names:
            setattr(data, key, tuple(map(str, names)))


def check_names(data: RobotData, where: str) -> None:
    """ValueError, which names `where`, for names that a policy file cannot have.

    An index has one name, or one for each of its values.
    """
    space = data.action_space
    actions = (1, space.n) if isinstance(space, Discrete) else (len(space.low),)
    for names, sizes, what in (
        (data.observation_names, (data.observation_size,), "observation"),
        (data.action_names, actions, "action"),
    ):
        expected = f"{' or '.join(map(str, sizes))} different names, or none"
        fits = len(set(names)) == len(names) in (0, *sizes)
        check(fits, f"{where}: names of the {what}", expected, names)
        for name in names:
            usable = name.isprintable() and 0 < len(name.encode()) <= LONGEST_NAME
            expected = f"1 to {LONGEST_NAME} bytes of printable characters"
            check(usable, f"{where}: names of the {what}", expected, repr(name))


def space_to_json(space: ActionSpace) -> dict[str, Any]:
    """Returns an action space as in the files of spiketrain."""
    if isinstance(space, Discrete):
        return {"n": space.n}
    return {"low": list(space.low), "high": list(space.high)}


def space_from_json(value: Any, where: str) -> ActionSpace:
    """Reads what space_to_json() returns. ValueError, which names `where`, for anything else."""
    expected = '{"n": N}, or {"low": [...], "high": [...]} with low below high'
    check(isinstance(value, dict), where, expected, value)
    if value.keys() == {"n"}:
        n = value["n"]
        check(type(n) is int and 1 <= n <= LARGEST_DISCRETE, where, expected, value)
        return Discrete(n)
    check(value.keys() == {"low", "high"}, where, expected, value)
    try:
        low, high = (np.asarray(value[key], np.float32) for key in ("low", "high"))
    except (TypeError, ValueError):
        low = high = np.zeros(0, np.float32)
    ordered = low.ndim == 1 and low.shape == high.shape and len(low) and bool(np.all(low < high))
    finite = bool(np.isfinite(low).all() and np.isfinite(high).all())
    check(bool(ordered and finite), where, expected, value)
    return Box(tuple(low.tolist()), tuple(high.tolist()))
