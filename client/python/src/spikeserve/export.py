"""Writes policy files from PyTorch state dicts or NumPy arrays.

    from spikeserve.export import ModelConfig, export_policy, tensor_shapes

    export_policy("policies/mine/1/policy.safetensors", model.state_dict(), ModelConfig(),
                  action_space=env.action_space, environment="CartPole-v1",
                  return_offset=250, return_scale=250, target_return=500)

`to_nir` writes the spiking populations of a policy file in NIR (docs/design/chips.md).

The exporter checks everything that the server checks, before it writes anything. It needs the
package `safetensors` (`spikeserve[export]`), and neither PyTorch nor a server.
"""

from __future__ import annotations

import json
import os
import pathlib
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.model_config import ModelConfig
from spikeserve.nir_export import to_nir
from spikeserve.spaces import ActionSpace, Discrete, as_action_space
from spikeserve.tensor_shapes import Shape, tensor_shapes

__all__ = ["ModelConfig", "export_policy", "tensor_shapes", "to_nir"]

FORMAT = "spikeserve.policy.v1"


def export_policy(
    path: str | os.PathLike[str],
    tensors: Mapping[str, Any],
    config: ModelConfig,
    *,
    action_space: Any,
    environment: str,
    target_return: float,
    return_offset: float = 0.0,
    return_scale: float = 1.0,
    modulator_mean: float = 0.0,
    modulator_std: float = 1.0,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Writes a policy file to `path`. Creates its folder if it does not exist.

    `tensors` holds exactly the tensors of tensor_shapes(), as PyTorch tensors (anything with
    detach().cpu().numpy()) or as arguments of numpy.asarray. The file stores them as float32.
    `action_space` is a Discrete or Box of Gymnasium or of spikeserve. The input of the return
    token is (G - return_offset) / return_scale. `training` is a JSON object. ListPolicies shows
    its evaluation.mean_return as the training return.

    ValueError names the tensor or field, the expected value and the received value. An error
    leaves the old file at `path` as it is. The write is atomic, so no reader sees a partial file.
    """
    import safetensors.numpy  # an optional dependency that agents do not need

    expected = "float32; `spiketrain quantize` makes the integers of a policy"
    check(not config.is_integer, "arithmetic", expected, repr(config.arithmetic))
    space = as_action_space(action_space)
    _check_space(space)
    arrays = {name: _convert(name, tensor) for name, tensor in tensors.items()}
    _check_tensors(arrays, config, _action_size(space))
    numbers = {
        "return_offset": _number("return_offset", return_offset),
        "return_scale": _number("return_scale", return_scale, positive=True),
        "target_return": _number("target_return", target_return),
        "modulator_mean": _number("modulator_mean", modulator_mean),
        "modulator_std": _number("modulator_std", modulator_std, positive=True),
    }
    metadata = {
        "format": FORMAT,
        "config": json.dumps(_config_values(config)),
        "action_space": json.dumps({"type": type(space).__name__, **asdict(space)}),
        "environment": environment,
        "training": _json("training", training or {}),
        **numbers,
    }
    _write_atomically(pathlib.Path(path), safetensors.numpy.save(arrays, metadata))


def _action_size(space: ActionSpace) -> int:
    return space.n if isinstance(space, Discrete) else len(space.low)


def _check_space(space: ActionSpace) -> None:
    if isinstance(space, Discrete):
        check(space.n >= 1, "action_space.n", "at least 1", space.n)
        return
    lows, highs = len(space.low), len(space.high)
    fits = lows == highs >= 1
    check(fits, "action_space", "low and high of one length from 1", f"{lows} and {highs}")
    for i, (low, high) in enumerate(zip(space.low, space.high, strict=True)):
        fits = np.isfinite(low) and np.isfinite(high) and low < high
        expected = f"finite bounds with low[{i}] < high[{i}]"
        check(fits, "action_space", expected, f"{low} and {high}")


def _config_values(config: ModelConfig) -> dict[str, Any]:
    values = asdict(config)
    # Without these keys, servers that do not know them can read the file.
    for field in ("arithmetic", "leak", "attention", "input_fraction", "residual_fraction"):
        del values[field]  # of arithmetic integer
    if not config.observation_changes:
        del values["observation_changes"]
    if config.has_norms:
        del values["norm"]
    return values


def _convert(name: str, tensor: Any) -> NDArray[Any]:
    array = _real(name, tensor)
    with np.errstate(over="ignore"):  # an overflow becomes infinite, which _check_tensor rejects
        return np.ascontiguousarray(array, np.float32).reshape(array.shape)


def _real(name: str, tensor: Any) -> NDArray[Any]:
    try:
        array = np.asarray(tensor.detach().cpu().numpy() if hasattr(tensor, "detach") else tensor)
    except (TypeError, ValueError) as error:
        received = f"{type(tensor).__name__} ({error})"
        raise ValueError(f'tensor "{name}": expected real numbers, received {received}') from error
    check(array.dtype.kind in "fiu", f'tensor "{name}"', "real numbers", f"dtype {array.dtype}")
    return array


def _check_tensors(
    arrays: Mapping[str, NDArray[Any]], config: ModelConfig, action_size: int
) -> None:
    mean = 'tensor "observation.mean"'
    check("observation.mean" in arrays, mean, "a tensor", "none")
    observation_size = arrays["observation.mean"].size
    check(observation_size >= 1, mean, "at least one value", 0)
    expected = tensor_shapes(config, observation_size, action_size)
    for name in expected:
        check(name in arrays, f'tensor "{name}"', "a tensor", "none")
    for name in arrays:
        check(name in expected, f'tensor "{name}"', f"no such tensor in mode {config.mode}", "one")
    for name, shape in expected.items():
        _check_tensor(name, arrays[name], shape)
    for name in ("observation.std", "observation.change_std"):
        scales = arrays.get(name, np.ones(1))
        for i in np.flatnonzero(scales <= 0)[:1]:
            check(False, f'tensor "{name}"', "positive numbers", f"{scales[i]} at index {i}")


def _check_tensor(name: str, array: NDArray[Any], expected: Shape) -> None:
    field = f'tensor "{name}"'
    fits = len(array.shape) == len(expected) and all(
        length >= 1 if wanted is None else length == wanted
        for length, wanted in zip(array.shape, expected, strict=True)
    )
    lengths = ", ".join("any" if length is None else str(length) for length in expected)
    check(fits, field, f"shape [{lengths}]", list(array.shape))
    for i in np.flatnonzero(~np.isfinite(array))[:1]:
        check(False, field, "numbers finite in float32", f"{array.flat[i]} at index {i}")


def _json(field: str, value: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(value), allow_nan=False)
    except (TypeError, ValueError) as error:
        received = f"{type(value).__name__} ({error})"
        raise ValueError(f"{field}: expected a JSON object, received {received}") from error


def _number(field: str, value: float, positive: bool = False) -> str:
    with np.errstate(over="ignore"):
        number = np.float32(value)
    fits = bool(np.isfinite(number) and (number > 0 or not positive))
    check(fits, field, "a positive finite number" if positive else "a finite number", value)
    return str(number)


def _write_atomically(path: pathlib.Path, contents: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f"{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(contents)
            os.fchmod(descriptor, 0o644)  # mkstemp gives read access to the owner only
            file.flush()
            os.fsync(descriptor)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
