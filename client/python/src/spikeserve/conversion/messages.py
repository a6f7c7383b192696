"""Finds the numbers in decoded messages: JSON values, ROS messages, protobuf messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check


def numbers_of(message: Any, path: str, where: str) -> NDArray[Any]:
    """Returns the number, or the list of numbers, of the field `path` such as "pose.x" as [size].

    Without a path the message must have exactly one such field. ValueError names `where`.
    """
    value = message
    for key in path.split(".") if path else []:
        members = _members(value)
        received = f"a message with {', '.join(members) or 'no fields'}"
        check(key in members, where, f"the field {path}", received)
        value = members[key]
    numbers = _numbers(value)
    if numbers is not None:
        return numbers
    fields = {
        key: found
        for key, member in _members(value).items()
        if (found := _numbers(member)) is not None
    }
    names = ", ".join(fields) or "none"
    expected = "a number or a list of numbers, or one field of these; TOPIC.FIELD selects one"
    check(len(fields) == 1, where, expected, names)
    return next(iter(fields.values()))


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
