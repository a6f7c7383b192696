"""Maps the observation dictionary of a client to the vector of a policy."""

from __future__ import annotations

import itertools
import json
import pathlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.gateway.numpy_msgpack import Undecoded

_MOST_NAMES, _LONGEST_NAME = 20, 64  # of entries in an error


@dataclass(frozen=True)
class Part:
    """Some numbers of the vector: those of an entry of the dictionary, flattened."""

    key: str
    elements: tuple[int, ...] = ()  # of the flattened entry; empty: all of them
    size: int | None = None  # of the flattened entry; None: any
    scale: float = 1.0  # the numbers are multiplied by this

    def read(self, observation: Mapping[Any, Any], most: int) -> NDArray[np.float32]:
        """Returns at most `most` numbers.

        ValueError, which names the key, for a missing or wrong entry.
        """
        value = _find(observation, self.key)
        try:
            array = np.asarray(value)
        except ValueError:  # lists of several lengths
            array = np.asarray(None)
        _check_decoded(value, self.key)
        check(array.dtype.kind in "biuf", self.key, "numbers", _kind(value))
        flat = array.ravel()  # an image that is named by mistake is not converted
        if self.size is not None:
            shape = f"shape {array.shape}"
            check(flat.size == self.size, self.key, f"{self.size} numbers", shape)
        if self.elements:
            largest = max(self.elements)
            check(largest < flat.size, self.key, f"at least {largest + 1} numbers", flat.size)
            flat = flat[list(self.elements)]
        check(flat.size <= most, self.key, f"{most} numbers, as the policy observes", flat.size)
        numbers = flat.astype(np.float64) * self.scale
        check(bool(np.isfinite(numbers).all()), self.key, "finite numbers", numbers.tolist())
        return numbers.astype(np.float32)

    @property
    def length(self) -> int | None:
        """Returns how many numbers read() returns; None: as many as the client sends."""
        return len(self.elements) or self.size


@dataclass(frozen=True)
class Step:
    """What one message of a client says."""

    observation: NDArray[np.float32]
    reward: float = 0.0  # for the last action
    reset: bool = False  # the observation is the first of an episode
    terminated: bool = False  # the observation is the last of an episode
    truncated: bool = False


@dataclass(frozen=True)
class ObservationMapping:
    """The parts of the vector in their order, and the keys of the other entries."""

    observation: tuple[Part, ...] = (Part("observation"),)
    reward: str = "reward"
    reset: str = "reset"
    terminated: str = "terminated"
    truncated: str = "truncated"
    names: tuple[str, ...] = ()  # of the vector's numbers, by which the policy's order is found

    @property
    def length(self) -> int | None:
        """Returns the length of the vector, or None if the clients decide."""
        lengths = [part.length for part in self.observation]
        return None if None in lengths else sum(filter(None, lengths))

    def read(self, observation: Any, size: int) -> Step:
        """Reads a message for a policy with observations of `size` numbers.

        Entries that the mapping does not name are ignored. ValueError, which names the key.
        """
        is_dict = isinstance(observation, dict)
        check(is_dict, "observation", "a dictionary", type(observation).__name__)
        vector = np.concatenate([part.read(observation, size) for part in self.observation])
        keys = " + ".join(part.key for part in self.observation)
        check(vector.size == size, keys, f"{size} numbers, as the policy observes", vector.size)
        return Step(
            vector,
            reward=_number(observation, self.reward),
            reset=bool(_number(observation, self.reset)),
            terminated=bool(_number(observation, self.terminated)),
            truncated=bool(_number(observation, self.truncated)),
        )


def _find(observation: Mapping[Any, Any], key: str) -> Any:
    """Returns an entry. A key such as "state/arm" is also that of a dictionary in a dictionary."""
    if key in observation:
        return observation[key]
    head, separator, rest = key.partition("/")
    inner = observation.get(head)
    if separator and isinstance(inner, dict):
        return _find(inner, rest)
    names = [str(name)[:_LONGEST_NAME] for name in itertools.islice(observation, _MOST_NAMES)]
    more = f" and {len(observation) - len(names)} more" if len(observation) > len(names) else ""
    known = ", ".join(sorted(names)) + more or "nothing"
    raise ValueError(f"{key}: expected an entry, received a dictionary of {known}")


def _check_decoded(value: Any, key: str) -> None:
    if isinstance(value, Undecoded):
        raise ValueError(f"{key}: {value.reason}")


def _kind(value: Any) -> str:
    return f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__


def _number(observation: Mapping[Any, Any], key: str) -> float:
    """Returns a number or a bool, 0 if there is none."""
    value = observation.get(key)
    if value is None:
        return 0.0
    _check_decoded(value, key)
    array = np.asarray(value) if not isinstance(value, list | dict) else np.asarray(None)
    check(array.dtype.kind in "biuf" and array.size == 1, key, "a number", _kind(value))
    number = float(array.reshape(()))
    check(bool(np.isfinite(number)), key, "a finite number", number)
    return number


def load_mapping(path: pathlib.Path) -> ObservationMapping:
    """Reads a mapping file (docs/guides/openpi.md). ValueError, which names file and field."""
    try:
        value = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected a JSON file, received {error}") from error
    check(isinstance(value, dict), str(path), "an object", type(value).__name__)
    names = ("reward", "reset", "terminated", "truncated")
    _check_keys(value, ("observation", "names", *names), str(path))
    for name in names:
        if name in value:
            text = isinstance(value[name], str)
            check(text, f"{path}: {name}", "the key of an entry", value[name])
    parts = value.get("observation")
    where = f"{path}: observation"
    check(isinstance(parts, list) and bool(parts), where, "a list of keys or objects", parts)
    assert isinstance(parts, list)
    read = tuple(_part(part, f"{where}[{index}]") for index, part in enumerate(parts))
    keys = {name: value[name] for name in names if name in value}
    elements = value.get("names", [])
    are_names = isinstance(elements, list) and all(isinstance(each, str) for each in elements)
    check(are_names, f"{path}: names", "a list of names", elements)
    return ObservationMapping(read, **keys, names=tuple(elements))


def _check_keys(value: dict[str, Any], known: tuple[str, ...], where: str) -> None:
    unknown = [key for key in value if key not in known]
    check(not unknown, where, f"any of {', '.join(known)}", ", ".join(unknown))


def _part(value: Any, where: str) -> Part:
    if isinstance(value, str):
        return Part(value)
    check(isinstance(value, dict), where, "a key, or an object with one", value)
    _check_keys(value, ("key", "elements", "size", "scale"), where)
    key = value.get("key")
    check(isinstance(key, str), f"{where}.key", "the key of an entry", key)
    elements = value.get("elements", [])
    indices = isinstance(elements, list) and all(type(i) is int and i >= 0 for i in elements)
    check(indices, f"{where}.elements", "indices from 0", elements)
    size = value.get("size")
    check(
        size is None or (type(size) is int and size >= 1),
        f"{where}.size",
        "a positive integer",
        size,
    )
    if size is not None and elements:
        below = max(elements) < size
        check(below, f"{where}.elements", f"indices below {size}", elements)
    scale = value.get("scale", 1.0)
    finite = type(scale) in (int, float) and bool(np.isfinite(scale))
    check(finite, f"{where}.scale", "a number", scale)
    return Part(str(key), tuple(elements), size, float(scale))
