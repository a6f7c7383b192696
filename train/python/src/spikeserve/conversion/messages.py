"""Finds the numbers in decoded messages: JSON values, ROS messages, protobuf messages."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check

# Fields with the names of the numbers beside them, such as `name` of JointState and `joint_names`.
_NAMES = re.compile(r"(names?|labels?|ids?|keys)$|^joints$", re.IGNORECASE)
_NAMES_OF_ROS = ("name", "joint_names")


@dataclass(frozen=True)
class Numbers:
    """The numbers of a field, [size], and their names, if the message has them."""

    values: NDArray[Any]
    names: tuple[str, ...] | None = None


def numbers_of(message: Any, path: str, where: str) -> Numbers:
    """Returns the number, or the list of numbers, of the field `path` such as "pose.x".

    Without a path the message must have exactly one such field. The names are those of a list of
    as many texts beside the numbers, or beside a message that contains them. ValueError names
    `where`.
    """
    value = message
    parents = [message]
    for key in path.split(".") if path else []:
        members = _members(value)
        received = f"a message with {', '.join(members) or 'no fields'}"
        check(key in members, where, f"the field {path}", received)
        value = members[key]
        parents.append(value)
    if not path:
        value = _only_field(message, where)
    else:
        parents.pop()
    numbers = _numbers(value)
    if numbers is None and _is_empty(value):
        numbers = np.zeros(0)
    expected = "a number or a list of numbers, or one field of these; TOPIC.FIELD selects one"
    check(numbers is not None, where, expected, "none")
    assert numbers is not None
    names = _names_of(parents, numbers, np.ndim(value) == 0, where)
    check(numbers.size > 0 or names is not None, where, expected, "none")
    return Numbers(numbers, names)


def _only_field(message: Any, where: str) -> Any:
    if _numbers(message) is not None:
        return message
    fields = {
        key: member for key, member in _members(message).items() if _numbers(member) is not None
    }
    expected = "a number or a list of numbers, or one field of these; TOPIC.FIELD selects one"
    check(len(fields) == 1, where, expected, ", ".join(fields) or "none")
    return next(iter(fields.values()))


def _names_of(
    parents: list[Any], numbers: NDArray[Any], scalar: bool, where: str
) -> tuple[str, ...] | None:
    """Returns the names of the innermost message that has some. ValueError if they do not fit."""
    for depth, parent in enumerate(reversed(parents)):
        for key, member in _members(parent).items():
            if not _NAMES.search(key):
                continue
            if scalar:
                if key == "name" and isinstance(member, str) and depth == 0:
                    return (member,)
                continue
            names = _texts(member)
            if names is None:
                continue
            if numbers.size == 0:  # a publisher that does not measure this field
                return ()
            if len(names) == numbers.size:
                check(len(set(names)) == len(names), f"{where}: {key}", "distinct names", names)
                return names
            if depth == 0 and key in _NAMES_OF_ROS:
                check(False, f"{where}: {key}", f"{numbers.size} names, one a number", len(names))
    return None


def _texts(value: Any) -> tuple[str, ...] | None:
    """Returns a list of at least one text; otherwise None."""
    if isinstance(value, str | bytes | dict) or not hasattr(value, "__len__"):
        return None
    texts = tuple(value)
    return texts if texts and all(isinstance(text, str) for text in texts) else None


def _is_empty(value: Any) -> bool:
    return (
        not isinstance(value, str | bytes | dict) and hasattr(value, "__len__") and not len(value)
    )


def _members(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        return value
    descriptor = getattr(value, "DESCRIPTOR", None)  # of protobuf
    if descriptor is not None:
        return {field.name: getattr(value, field.name) for field in descriptor.fields}
    slots = getattr(type(value), "__slots__", None)  # of mcap_ros2
    if slots:
        return {name: getattr(value, name) for name in slots if not name.startswith("_")}
    return {k: v for k, v in getattr(value, "__dict__", {}).items() if not k.startswith("_")}


def _numbers(value: Any) -> NDArray[Any] | None:
    """Returns a number or a flat list of at least one number as an array; otherwise None."""
    if isinstance(value, str | bytes | dict):
        return None
    if not isinstance(value, bool | int | float | np.ndarray | Sequence) and not hasattr(
        value, "__array__"
    ):
        if not hasattr(value, "__len__") or not hasattr(value, "__getitem__"):
            return None
        value = list(value)  # a repeated field of protobuf
    try:
        array = np.asarray(value)
    except ValueError:  # rows of several lengths
        return None
    if array.dtype.kind not in "biuf" or array.ndim > 1 or array.size == 0:
        return None
    return array.reshape(-1).astype(np.int64 if array.dtype.kind in "biu" else np.float64)
