"""MessagePack with NumPy arrays, in the encoding of the package openpi-client.

An array is the map {__ndarray__: true, data, dtype, shape}, and a NumPy scalar {__npgeneric__:
true, data, dtype}, with keys of bytes. Thread-safe.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check

_KINDS = "biuf"  # bool, int, unsigned, float: types that hold no pointers
_MOST_DIMENSIONS = 8
MOST_VALUES = 4096  # of a message; an array of numbers is one, and its description six


def pack(value: Any) -> bytes:
    """Encodes nested dicts and lists of numbers, texts and arrays."""
    packed: bytes = msgpack.packb(value, default=_pack_array)
    return packed


@dataclass(frozen=True)
class Undecoded:
    """An array of no numbers, such as texts. Only a mapping that names its entry refuses it."""

    reason: str


def unpack(data: bytes) -> Any:
    """Decodes what openpi-client sends. ValueError for anything else."""
    _check_lengths(data)
    try:
        return msgpack.unpackb(data, object_hook=_unpack_array, strict_map_key=False)
    except msgpack.exceptions.ExtraData as error:
        raise ValueError("message: expected one value, received bytes after it") from error
    except (msgpack.exceptions.UnpackException, TypeError, RecursionError) as error:
        raise ValueError(f"message: expected MessagePack, received other bytes: {error}") from error
    except UnicodeDecodeError as error:
        raise ValueError("message: expected texts in UTF-8, received other bytes") from error


# By the first byte of a value: the bytes of the number behind it, and what this number counts.
_SIZED = {
    **dict.fromkeys((0xC4, 0xD9), (1, "bytes")),
    **dict.fromkeys((0xC5, 0xDA), (2, "bytes")),
    **dict.fromkeys((0xC6, 0xDB), (4, "bytes")),
    **dict(zip((0xC7, 0xC8, 0xC9), ((1, "typed"), (2, "typed"), (4, "typed")), strict=True)),
    **dict(zip((0xDC, 0xDD), ((2, "values"), (4, "values")), strict=True)),
    **dict(zip((0xDE, 0xDF), ((2, "pairs"), (4, "pairs")), strict=True)),
}
# By the first byte of a value of fixed length: the bytes behind it.
_FIXED = {
    **dict.fromkeys((0xC0, 0xC2, 0xC3), 0),
    **{0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8},
    **{0xD4 + i: 1 + (1 << i) for i in range(5)},
}


def _check_lengths(data: bytes) -> None:
    """ValueError if decoding `data` would make more than MOST_VALUES values.

    Reads the lengths alone, and allocates nothing. The numbers of an array are one value. What is
    no MessagePack passes: the decoder refuses it.
    """
    waiting, seen, at = 1, 0, 0
    while waiting > 0 and at < len(data):
        first = data[at]
        at += 1
        waiting -= 1
        seen += 1
        if first in _SIZED:
            width, what = _SIZED[first]
            length = int.from_bytes(data[at : at + width], "big")
            at += width
            at += {"bytes": length, "typed": length + 1}.get(what, 0)
            waiting += {"values": length, "pairs": 2 * length}.get(what, 0)
        elif 0x80 <= first < 0xA0:  # a short dictionary or list
            waiting += (first & 0x0F) * (2 if first < 0x90 else 1)
        elif 0xA0 <= first < 0xC0:  # a short text
            at += first & 0x1F
        else:
            at += _FIXED.get(first, 0)
        if seen + waiting > MOST_VALUES:
            expected = f"at most {MOST_VALUES} values; send numbers as arrays"
            raise ValueError(f"message: expected {expected}, received more")


def _pack_array(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"expected a number, text, array, list or dict, received {type(value)}")


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    name = value.get(b"dtype")
    expected = "numbers, such as <f4"
    short = isinstance(name, str) and len(name) <= 8
    check(short, "array: dtype", expected, type(name).__name__)
    try:
        dtype = np.dtype(str(name))
    except TypeError as error:
        raise ValueError(f"array: dtype: expected {expected}, received {name!r}") from error
    check(dtype.kind in _KINDS, "array: dtype", expected, name)
    return dtype


def _unpack_array(value: dict[Any, Any]) -> Any:
    try:
        if b"__ndarray__" in value:
            return _array_of(value)
        return _number_of(value) if b"__npgeneric__" in value else value
    except ValueError as error:
        return Undecoded(str(error))


def _array_of(value: dict[Any, Any]) -> NDArray[Any]:
    dtype, data, shape = _dtype(value), value.get(b"data"), value.get(b"shape")
    few = isinstance(shape, list) and len(shape) <= _MOST_DIMENSIONS
    check(few, "array: shape", f"a list of at most {_MOST_DIMENSIONS} sizes", type(shape).__name__)
    assert isinstance(shape, list)
    check(all(type(n) is int and n >= 0 for n in shape), "array: shape", "sizes", shape)
    expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
    received = len(data) if isinstance(data, bytes) else type(data).__name__
    check(received == expected, "array: data", f"{expected} bytes", received)
    assert isinstance(data, bytes)
    return np.frombuffer(data, dtype).reshape(shape)


def _number_of(value: dict[Any, Any]) -> Any:
    dtype, data = _dtype(value), value.get(b"data")
    check(isinstance(data, bool | int | float), "number: data", "a number", type(data).__name__)
    try:
        return dtype.type(data)
    except OverflowError as error:
        raise ValueError(f"number: data: expected {dtype}, received {data}") from error
