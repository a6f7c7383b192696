"""Writes policy files from PyTorch state dicts or NumPy arrays.

    from spikeserve.export import ModelConfig, export_policy, tensor_shapes

    export_policy("policies/mine/1/policy.safetensors", model.state_dict(), ModelConfig(),
                  action_space=env.action_space, environment="CartPole-v1",
                  return_offset=250, return_scale=250, target_return=500)

Everything the server's strict reader would refuse is refused here, before anything is written.
Needs the package `safetensors`, the extra `spikeserve[export]`; neither PyTorch nor a server.
"""

from __future__ import annotations

import json
import os
import pathlib
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.model_config import ModelConfig
from spikeserve.spaces import ActionSpace, Discrete, as_action_space

__all__ = ["ModelConfig", "export_policy", "tensor_shapes"]

FORMAT = "spikeserve.policy.v1"

# A tensor's lengths; None is any length from 1.
Shape = tuple[int | None, ...]


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
    """Writes a policy to `path`, making its folder if need be.

    `tensors` holds every tensor of tensor_shapes() and no other: PyTorch tensors (anything with
    detach().cpu().numpy()) or what NumPy can make an array of; they are stored as float32.
    `action_space` is a Discrete or Box of Gymnasium or of spikeserve. The return token's input is
    (G - return_offset) / return_scale. `training` is anything JSON can hold; its
    evaluation.mean_return is what ListPolicies shows as the training return.

    ValueError names the tensor or field, what was expected and what was received; nothing is
    written then. A file at `path` is replaced all at once: no reader sees half a policy.
    """
    import safetensors.numpy  # an extra: agents have no need of it

    space = as_action_space(action_space)
    _check_space(space)
    arrays = {name: _float32(name, tensor) for name, tensor in tensors.items()}
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
        "config": json.dumps(asdict(config)),
        "action_space": json.dumps({"type": type(space).__name__, **asdict(space)}),
        "environment": environment,
        "training": _json("training", training or {}),
        **numbers,
    }
    _write_atomically(pathlib.Path(path), safetensors.numpy.save(arrays, metadata))


def tensor_shapes(config: ModelConfig, observation_size: int, action_size: int) -> dict[str, Shape]:
    """The tensors of a policy file and their shapes. `action_size` is n of a Discrete space, the
    length of a Box.
    """
    d = config.hidden_size
    shapes: dict[str, Shape] = {}
    inputs = {"return": 1, "state": observation_size, "action": action_size}
    for modality, size in inputs.items():
        shapes |= _linear(f"embed.{modality}", d, size)
        shapes |= _pair(f"embed.{modality}.norm", "weight", d)
    if config.is_dense:
        shapes["embed.timestep.weight"] = (None, d)
    if config.has_phase:
        shapes["phase.omega"] = shapes["phase.phi"] = (config.heads,)
    for layer in range(config.layers):
        shapes |= _layer_shapes(config, f"layers.{layer}")
    if not config.is_dense:
        shapes |= _pair("readout.coder", "gain", d)
    shapes |= _linear("head", action_size, d)
    shapes["observation.mean"] = shapes["observation.std"] = (observation_size,)
    return shapes


def _layer_shapes(config: ModelConfig, layer: str) -> dict[str, Shape]:
    d = config.hidden_size
    attention = f"{layer}.attention"
    shapes: dict[str, Shape] = {}
    for projection in ("query", "key", "value"):
        shapes |= _linear(f"{attention}.{projection}", d, config.attention_inputs)
    if not config.is_dense:
        shapes |= _pair(f"{layer}.coder", "gain", d)
        shapes |= _pair(f"{layer}.ffn.coder", "gain", d)
        shapes[f"{attention}.scale"] = (config.heads,)
    if config.has_routing:
        shapes |= _linear(f"{layer}.routing.hidden", config.routing_hidden_size, d)
        shapes |= _linear(f"{layer}.routing.gate", config.heads, config.routing_hidden_size)
    shapes |= _linear(f"{attention}.output", d, config.merged_size)
    shapes |= _pair(f"{attention}.norm", "weight", d)
    shapes |= _linear(f"{layer}.ffn.hidden", config.ffn_size, d)
    shapes |= _linear(f"{layer}.ffn.output", d, config.ffn_size)
    shapes |= _pair(f"{layer}.ffn.norm", "weight", d)
    return shapes


def _linear(name: str, outputs: int, inputs: int) -> dict[str, Shape]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _pair(name: str, factor: str, size: int) -> dict[str, Shape]:
    return {f"{name}.{factor}": (size,), f"{name}.bias": (size,)}


def _action_size(space: ActionSpace) -> int:
    return space.n if isinstance(space, Discrete) else len(space.low)


def _check_space(space: ActionSpace) -> None:
    if isinstance(space, Discrete):
        if space.n < 1:
            raise ValueError(f"action_space.n: expected at least 1, got {space.n}")
        return
    if not space.low or len(space.low) != len(space.high):
        raise ValueError(
            f"action_space: expected low and high of one length from 1, "
            f"got {len(space.low)} and {len(space.high)}"
        )
    for i, (low, high) in enumerate(zip(space.low, space.high, strict=True)):
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise ValueError(
                f"action_space: expected finite bounds with low[{i}] < high[{i}], "
                f"got {low} and {high}"
            )


def _float32(name: str, tensor: Any) -> NDArray[np.float32]:
    try:
        array = np.asarray(tensor.detach().cpu().numpy() if hasattr(tensor, "detach") else tensor)
    except (TypeError, ValueError) as error:
        raise ValueError(f'tensor "{name}": expected an array of numbers, got {error}') from error
    if array.dtype.kind not in "fiu":
        raise ValueError(f'tensor "{name}": expected real numbers, got dtype {array.dtype}')
    with np.errstate(over="ignore"):  # what overflows is refused as infinite
        return np.ascontiguousarray(array, np.float32).reshape(array.shape)


def _check_tensors(
    arrays: Mapping[str, NDArray[np.float32]], config: ModelConfig, action_size: int
) -> None:
    if "observation.mean" not in arrays:
        raise ValueError('tensor "observation.mean": expected, but missing')
    observation_size = arrays["observation.mean"].size
    if observation_size < 1:
        raise ValueError('tensor "observation.mean": expected at least one value, got 0')
    expected = tensor_shapes(config, observation_size, action_size)
    for problem in _name_problems(arrays, expected, config):
        raise ValueError(problem)
    for name, shape in expected.items():
        _check_tensor(name, arrays[name], shape)
    deviation = arrays["observation.std"]
    for i in np.flatnonzero(deviation <= 0)[:1]:
        raise ValueError(
            f'tensor "observation.std": expected positive numbers, got {deviation[i]} at index {i}'
        )


def _name_problems(
    arrays: Mapping[str, Any], expected: Mapping[str, Shape], config: ModelConfig
) -> Iterator[str]:
    for name in expected:
        if name not in arrays:
            yield f'tensor "{name}": expected, but missing'
    for name in arrays:
        if name not in expected:
            yield f'tensor "{name}": not expected in a policy of mode {config.mode}'


def _check_tensor(name: str, array: NDArray[np.float32], expected: Shape) -> None:
    fits = len(array.shape) == len(expected) and all(
        length >= 1 if wanted is None else length == wanted
        for length, wanted in zip(array.shape, expected, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if length is None else str(length) for length in expected)
        raise ValueError(f'tensor "{name}": expected shape [{wanted}], got {list(array.shape)}')
    for index in np.flatnonzero(~np.isfinite(array))[:1]:
        raise ValueError(
            f'tensor "{name}": expected numbers finite in float32, '
            f"got {array.flat[index]} at index {index}"
        )


def _json(field: str, value: Mapping[str, Any]) -> str:
    try:
        return json.dumps(dict(value), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{field}: expected what JSON can hold, got {error}") from error


def _number(field: str, value: float, positive: bool = False) -> str:
    with np.errstate(over="ignore"):
        number = np.float32(value)
    if not np.isfinite(number) or (positive and number <= 0):
        kind = "a positive finite number" if positive else "a finite number"
        raise ValueError(f"{field}: expected {kind}, got {value}")
    return str(number)


def _write_atomically(path: pathlib.Path, contents: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f"{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(contents)
            os.fchmod(descriptor, 0o644)  # mkstemp lets only the owner read
            file.flush()
            os.fsync(descriptor)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
