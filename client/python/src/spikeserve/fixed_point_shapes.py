"""The shapes of the tensors of a policy in integer arithmetic (docs/design/integer.md)."""

from __future__ import annotations

from spikeserve.model_config import ModelConfig

# The lengths of a tensor. None stands for any length from 1.
Shape = tuple[int | None, ...]


def fixed_point_shapes(
    config: ModelConfig, observation_size: int, action_size: int
) -> dict[str, Shape]:
    """Returns the shape of every tensor but the head and the moments, by name."""
    d = config.hidden_size
    shapes: dict[str, Shape] = {}
    states = observation_size * (2 if config.observation_changes else 1)
    for modality, size in {"return": 1, "state": states, "action": action_size}.items():
        shapes |= _map(f"embed.{modality}", d, size)
        shapes |= _norm(config, f"embed.{modality}.norm")
    if config.is_dense:
        shapes["embed.timestep.weight"] = (None, d)
    if config.has_phase:
        shapes["phase.omega"] = shapes["phase.phi"] = (config.heads,)
    for layer in range(config.layers):
        shapes |= _layer(config, f"layers.{layer}")
    return shapes if config.is_dense else shapes | _coder(config, "readout.coder")


def _layer(config: ModelConfig, layer: str) -> dict[str, Shape]:
    d, attention = config.hidden_size, f"{layer}.attention"
    neurons = _map if config.is_dense else _population
    shapes: dict[str, Shape] = {}
    for projection in ("query", "key", "value"):
        shapes |= neurons(f"{attention}.{projection}", d, config.attention_inputs)
    if not config.is_dense:
        shapes |= _coder(config, f"{layer}.coder") | _coder(config, f"{layer}.ffn.coder")
        shapes[f"{attention}.scale"] = (config.heads,)
    if config.relative_bias:
        shapes[f"{attention}.relative"] = (config.heads, 3 * config.context)
    if config.has_routing:
        shapes |= _map(f"{layer}.routing.hidden", config.routing_hidden_size, d)
        shapes |= _map(f"{layer}.routing.gate", config.heads, config.routing_hidden_size)
    shapes |= _map(f"{attention}.output", d, config.merged_size)
    shapes |= _norm(config, f"{attention}.norm")
    shapes |= neurons(f"{layer}.ffn.hidden", config.ffn_size, d)
    shapes |= _map(f"{layer}.ffn.output", d, config.ffn_size)
    return shapes | _norm(config, f"{layer}.ffn.norm")


def _map(name: str, outputs: int, inputs: int) -> dict[str, Shape]:
    vectors: dict[str, Shape] = {f"{name}.{part}": (outputs,) for part in ("shift", "bias")}
    return {f"{name}.weight": (outputs, inputs)} | vectors


def _population(name: str, outputs: int, inputs: int) -> dict[str, Shape]:
    parts = ("scale", "bias", "threshold")
    vectors: dict[str, Shape] = {f"{name}.{part}": (outputs,) for part in parts}
    return {f"{name}.weight": (outputs, inputs)} | vectors


def _norm(config: ModelConfig, name: str) -> dict[str, Shape]:
    if not config.has_norms:
        return {}
    d = config.hidden_size
    return {f"{name}.weight": (d,), f"{name}.shift": (1,), f"{name}.bias": (d,)}


def _coder(config: ModelConfig, name: str) -> dict[str, Shape]:
    d = config.hidden_size
    return {f"{name}.sign": (d,), f"{name}.threshold": (d, config.ticks)}
