"""The tensors of a policy file and their shapes."""

from __future__ import annotations

from spikeserve.model_config import ModelConfig

# The lengths of a tensor. None stands for any length from 1.
Shape = tuple[int | None, ...]


def tensor_shapes(config: ModelConfig, observation_size: int, action_size: int) -> dict[str, Shape]:
    """Returns the shape of every tensor of a policy file, by name.

    `action_size` is n of a Discrete space, or the length of a Box. docs/design/integer.md has the
    tensors of integer arithmetic.
    """
    d = config.hidden_size
    shapes: dict[str, Shape] = {}
    states = observation_size * (2 if config.observation_changes else 1)
    for modality, size in {"return": 1, "state": states, "action": action_size}.items():
        shapes |= _map(config, f"embed.{modality}", d, size)
        shapes |= _norm(config, f"embed.{modality}.norm")
    if config.is_dense:
        shapes["embed.timestep.weight"] = (None, d)
    if config.has_phase:
        shapes["phase.omega"] = shapes["phase.phi"] = (config.heads,)
    for layer in range(config.layers):
        shapes |= _layer(config, f"layers.{layer}")
    if not config.is_dense:
        shapes |= _coder(config, "readout.coder")
    shapes |= {"head.weight": (action_size, d), "head.bias": (action_size,)}
    shapes["observation.mean"] = shapes["observation.std"] = (observation_size,)
    if config.observation_changes:
        shapes["observation.change_std"] = (observation_size,)
    return shapes


def _layer(config: ModelConfig, layer: str) -> dict[str, Shape]:
    d, attention = config.hidden_size, f"{layer}.attention"
    shapes: dict[str, Shape] = {}
    for projection in ("query", "key", "value"):
        shapes |= _neurons(config, f"{attention}.{projection}", d, config.attention_inputs)
    if not config.is_dense:
        shapes |= _coder(config, f"{layer}.coder") | _coder(config, f"{layer}.ffn.coder")
        shapes[f"{attention}.scale"] = (config.heads,)
    if config.has_routing:
        shapes |= _map(config, f"{layer}.routing.hidden", config.routing_hidden_size, d)
        shapes |= _map(config, f"{layer}.routing.gate", config.heads, config.routing_hidden_size)
    shapes |= _map(config, f"{attention}.output", d, config.merged_size)
    shapes |= _norm(config, f"{attention}.norm")
    shapes |= _neurons(config, f"{layer}.ffn.hidden", config.ffn_size, d)
    shapes |= _map(config, f"{layer}.ffn.output", d, config.ffn_size)
    return shapes | _norm(config, f"{layer}.ffn.norm")


def _map(
    config: ModelConfig,
    name: str,
    outputs: int,
    inputs: int,
    integer_parts: tuple[str, ...] = ("shift", "bias"),
) -> dict[str, Shape]:
    parts = integer_parts if config.is_integer else ("bias",)
    vectors: dict[str, Shape] = {f"{name}.{part}": (outputs,) for part in parts}
    return {f"{name}.weight": (outputs, inputs)} | vectors


def _neurons(config: ModelConfig, name: str, outputs: int, inputs: int) -> dict[str, Shape]:
    if config.is_dense:
        return _map(config, name, outputs, inputs)
    return _map(config, name, outputs, inputs, ("scale", "bias", "threshold"))


def _norm(config: ModelConfig, name: str) -> dict[str, Shape]:
    if not config.has_norms:
        return {}
    shapes: dict[str, Shape] = {f"{name}.weight": (config.hidden_size,)}
    if config.is_integer:
        shapes[f"{name}.shift"] = (1,)
    return shapes | {f"{name}.bias": (config.hidden_size,)}


def _coder(config: ModelConfig, name: str) -> dict[str, Shape]:
    d = config.hidden_size
    if config.is_integer:
        return {f"{name}.sign": (d,), f"{name}.threshold": (d, config.ticks)}
    return {f"{name}.gain": (d,), f"{name}.bias": (d,)}
