"""Rounds the spike-driven weights of a model to 8-bit integers, as `spiketrain quantize` does.

    from dataclasses import replace
    from spikeserve.export import export_policy
    from spikeserve.integer_weights import quantize

    export_policy(path, quantize(tensors, config), replace(config, arithmetic="int8"), ...)

Each output neuron has a scale. Its weights, its bias and its threshold are integers in units of
that scale; membranes and currents have 16 bits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.model_config import ModelConfig

__all__ = ["quantize"]

# The spike-driven maps of a layer: populations of neurons, and the map of spike counts to updates.
POPULATIONS = ("attention.query", "attention.key", "attention.value", "ffn.hidden")
OUTPUT = "ffn.output"

LARGEST_WEIGHT = 127
LARGEST_THRESHOLD = 16384  # of a neuron whose weights are all small
LARGEST_CURRENT = 32767  # 16 bits


def quantize(tensors: Mapping[str, Any], config: ModelConfig) -> dict[str, NDArray[Any]]:
    """Returns the tensors of the integer policy that is nearest to a float32 one.

    `tensors` are those of `export_policy` for `config`, which has arithmetic float32. The scale of
    neuron k is max over j of |w_kj| / 127, and at least threshold / 16384. Ties round to even.
    ValueError if a bias or a threshold does not fit 16 bits.
    """
    check(not config.is_int8, "arithmetic", "float32", repr(config.arithmetic))
    check(not config.is_dense, "mode", "a spiking mode", repr(config.mode))
    rounded: dict[str, Any] = dict(tensors)
    for layer in range(config.layers):
        for population in POPULATIONS:
            rounded |= _round_population(f"layers.{layer}.{population}", tensors, config)
        rounded |= _round_output(f"layers.{layer}.{OUTPUT}", tensors)
    return rounded


def integer_shapes(config: ModelConfig, layer: str) -> dict[str, tuple[int]]:
    """Returns the shapes of the tensors of one layer that only integer policies have."""
    d = config.hidden_size
    shapes = {f"{layer}.{OUTPUT}.scale": (d,)}
    for population in POPULATIONS:
        outputs = config.ffn_size if population == "ffn.hidden" else d
        shapes[f"{layer}.{population}.scale"] = (outputs,)
        shapes[f"{layer}.{population}.threshold"] = (outputs,)
    return shapes


def integer_dtype(name: str) -> type[np.signedinteger[Any]] | None:
    """Returns the dtype of a tensor of an integer policy, or None if it is float32."""
    map_name, _, part = name.rpartition(".")
    is_population = map_name.endswith(POPULATIONS)
    if part == "weight" and (is_population or map_name.endswith(OUTPUT)):
        return np.int8
    return np.int16 if is_population and part in ("bias", "threshold") else None


def check_integers(arrays: Mapping[str, NDArray[Any]], config: ModelConfig) -> None:
    """Raises ValueError if a number is out of its range, or if a current could leave 16 bits."""
    for layer in range(config.layers):
        for part in (*POPULATIONS, OUTPUT):
            name = f"layers.{layer}.{part}"
            _check_each(
                f"{name}.weight", arrays, lambda w: np.abs(w.astype(int)) <= 127, "-127 to 127"
            )
            _check_each(f"{name}.scale", arrays, lambda s: s > 0, "positive numbers")
        for population in POPULATIONS:
            name = f"layers.{layer}.{population}"
            _check_each(f"{name}.threshold", arrays, lambda t: t >= 1, "1 to 32767")
            _check_currents(name, arrays)


def _check_each(name: str, arrays: Mapping[str, NDArray[Any]], fits: Any, expected: str) -> None:
    array = arrays[name]
    for i in np.flatnonzero(~fits(array))[:1]:
        check(False, f'tensor "{name}"', expected, f"{array.flat[i]} at index {i}")


def _check_currents(name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    weight, bias = (arrays[f"{name}.{part}"].astype(int) for part in ("weight", "bias"))
    currents = np.abs(bias) + np.abs(weight).sum(axis=1)
    for k in np.flatnonzero(currents > LARGEST_CURRENT)[:1]:
        expected = f"|bias| + sum of |weight| of at most {LARGEST_CURRENT}"
        check(False, f'tensor "{name}.weight"', expected, f"{currents[k]} at index {k}")


def _float32(tensor: Any) -> NDArray[np.float32]:
    values = tensor.detach().cpu().numpy() if hasattr(tensor, "detach") else tensor
    return np.asarray(values, np.float32)


def _row_scale(weight: NDArray[np.float32]) -> NDArray[np.float32]:
    largest: NDArray[np.float32] = np.abs(weight).max(axis=1)
    return np.divide(largest, LARGEST_WEIGHT, dtype=np.float32)


def _round_weight(weight: NDArray[np.float32], scale: NDArray[np.float32]) -> NDArray[np.int8]:
    levels = np.rint(np.divide(weight, scale[:, None], dtype=np.float32))
    limited: NDArray[np.float32] = np.clip(levels, -LARGEST_WEIGHT, LARGEST_WEIGHT)
    return limited.astype(np.int8)


def _round_to_16_bits(name: str, units: NDArray[np.float32]) -> NDArray[np.int16]:
    levels = np.rint(units)
    for k in np.flatnonzero(~(np.abs(levels) <= LARGEST_CURRENT))[:1]:
        expected = f"at most {LARGEST_CURRENT} units"
        check(False, f'tensor "{name}"', expected, f"{levels[k]} at index {k}")
    return levels.astype(np.int16)


def _round_population(
    name: str, tensors: Mapping[str, Any], config: ModelConfig
) -> dict[str, NDArray[Any]]:
    weight, bias = (_float32(tensors[f"{name}.{part}"]) for part in ("weight", "bias"))
    threshold = np.float32(config.threshold)
    scale = np.maximum(_row_scale(weight), threshold / np.float32(LARGEST_THRESHOLD))
    thresholds = np.divide(threshold, scale, dtype=np.float32)
    biases = np.divide(bias, scale, dtype=np.float32)
    return {
        f"{name}.weight": _round_weight(weight, scale),
        f"{name}.scale": scale,
        f"{name}.bias": _round_to_16_bits(f"{name}.bias", biases),
        f"{name}.threshold": _round_to_16_bits(f"{name}.threshold", np.maximum(thresholds, 1)),
    }


def _round_output(name: str, tensors: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    weight = _float32(tensors[f"{name}.weight"])
    scale = _row_scale(weight)
    scale = np.where(scale > 0, scale, np.float32(1))
    return {f"{name}.weight": _round_weight(weight, scale), f"{name}.scale": scale}
