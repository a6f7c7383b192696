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
    try:
        return msgpack.unpackb(data, object_hook=_unpack_array, strict_map_key=False)
    except msgpack.exceptions.ExtraData as error:
        raise ValueError("message: expected one value, received bytes after it") from error
    except (msgpack.exceptions.UnpackException, TypeError, RecursionError) as error:
        raise ValueError(f"message: expected MessagePack, received other bytes: {error}") from error
    except UnicodeDecodeError as error:
        raise ValueError("message: expected texts in UTF-8, received other bytes") from error


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
    check(isinstance(name, str) and len(name) <= 8, "array: dtype", expected, name)
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
    sizes = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    check(sizes and len(shape or ()) <= _MOST_DIMENSIONS, "array: shape", "sizes", shape)
    assert isinstance(shape, list)
    expected = int(np.prod(shape, dtype=object)) * dtype.itemsize
    received = len(data) if isinstance(data, bytes) else type(data).__name__
    check(received == expected, "array: data", f"{expected} bytes", received)
    assert isinstance(data, bytes)
    return np.frombuffer(data, dtype).reshape(shape)


def _number_of(value: dict[Any, Any]) -> Any:
    dtype, data = _dtype(value), value.get(b"data")
    check(isinstance(data, bool | int | float), "number: data", "a number", data)
    try:
        return dtype.type(data)
    except OverflowError as error:
        raise ValueError(f"number: data: expected {dtype}, received {data}") from error
