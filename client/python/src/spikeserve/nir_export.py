"""Writes the spiking populations of a policy in NIR, the Neuromorphic Intermediate Representation.

    from spikeserve.export import to_nir

    exported = to_nir("deploy/policies/cartpole/2/policy.safetensors")
    exported.write("cartpole-nir")  # one .nir file for each population, and manifest.json

A population is an `Affine` node and a `LIF` node: the query, key, value and hidden neurons of each
layer. NIR cannot express the other parts (softmax attention, LayerNorm, routing, phase generators,
plasticity), so a host computes them. The manifest lists in which order host and populations follow
each other for a token, and what each of them passes on, and the names, units and ranges of the
elements of observation and action as the policy file has them.

Needs the packages `nir` and `safetensors` (`spikeserve[nir]`).
"""

from __future__ import annotations

import json
import os
import pathlib
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.model_config import ModelConfig

__all__ = ["NirExport", "to_nir"]

FORMAT = "spikeserve.nir.v2"
# snnTorch and others take this as the time of a step when they read a file.
TICK_SECONDS = 0.0001
# The leak of neurons that do not leak, and what is left of a membrane that leaks as a whole: with 0
# NIR's LIF neurons have no time constant, or one that importers refuse.
_NEGLIGIBLE = 2.0**-40
POPULATIONS = ("attention.query", "attention.key", "attention.value", "ffn.hidden")


@dataclass(frozen=True)
class NirExport:
    """The populations of a policy as NIR graphs, by name, and what a host does between them."""

    populations: dict[str, Any]  # nir.NIRGraph by name, such as "layers.0.attention.query"
    manifest: dict[str, Any]

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Writes `NAME.nir` for each population, and `manifest.json`, to a folder that it makes."""
        import nir

        path = pathlib.Path(folder)
        path.mkdir(parents=True, exist_ok=True)
        for name, graph in self.populations.items():
            nir.write(path / f"{name}.nir", graph)
        (path / "manifest.json").write_text(json.dumps(self.manifest, indent=2) + "\n")


def to_nir(policy: str | os.PathLike[str]) -> NirExport:
    """Converts a policy file. ValueError for another file, and for a policy without spikes.

    All neurons have the same threshold, as importers require. A neuron of NIR fires above its
    threshold, one of this project at its threshold or above, so the threshold of a float32 neuron
    is the next smaller number. The weights and biases of a policy with integers are divided by the
    neuron's threshold less half a unit, and the threshold is 1; the manifest has the divisors.
    NIR has real-valued membranes: those of a policy with integers, which are rounded to integers
    at every tick, can differ from them by a few units.
    """
    import safetensors

    try:
        with safetensors.safe_open(policy, "numpy") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            metadata = file.metadata() or {}
        values = dict(json.loads(metadata.get("config", "")))
        features = json.loads(metadata.get("features", "{}"))
        known = {field.name for field in fields(ModelConfig)}
        config = ModelConfig(**{name: value for name, value in values.items() if name in known})
    except (safetensors.SafetensorError, TypeError, ValueError) as error:
        raise ValueError(f"{policy}: expected a policy file, received another: {error}") from error
    check(not config.is_dense, "mode", "a spiking mode", repr(config.mode))
    names = [f"layers.{i}.{part}" for i in range(config.layers) for part in POPULATIONS]
    for tensor in (f"{name}.{part}" for name in names for part in ("weight", "bias")):
        check(tensor in tensors, f"{policy}: {tensor}", "a tensor", "none")
    graphs = {name: _population(name, tensors, config) for name in names}
    return NirExport(graphs, _manifest(config, tensors) | {"features": features})


def _population(name: str, tensors: dict[str, NDArray[Any]], config: ModelConfig) -> Any:
    import nir

    weight, bias = (tensors[f"{name}.{part}"] for part in ("weight", "bias"))
    threshold = float(np.nextafter(np.float32(config.threshold), np.float32(-np.inf)))
    units = _units(name, tensors)
    if units is not None:
        weight, bias, threshold = weight / units[:, np.newaxis], bias / units, 1.0
    leak, ones = _leak(config), np.ones(len(weight), np.float64)
    lif = nir.LIF(
        tau=TICK_SECONDS / leak * ones,
        r=ones / leak,
        v_leak=0 * ones,
        v_threshold=threshold * ones,
        v_reset=0 * ones,
    )
    affine = nir.Affine(weight=weight.astype(np.float32), bias=bias.astype(np.float32))
    return nir.NIRGraph.from_list(affine, lif)


def _leak(config: ModelConfig) -> float:
    """Returns the share of a membrane that leaks at each tick."""
    leak = 1 - float(np.float32(config.membrane_decay))
    return min(max(leak, _NEGLIGIBLE), 1 - _NEGLIGIBLE)


def _units(name: str, tensors: dict[str, NDArray[Any]]) -> NDArray[np.float64] | None:
    """Returns what the integers of each neuron are divided by; None: they are float32 numbers."""
    thresholds = tensors.get(f"{name}.threshold")
    return None if thresholds is None else thresholds.astype(np.float64) - 0.5


def _manifest(config: ModelConfig, tensors: dict[str, NDArray[Any]]) -> dict[str, Any]:
    steps = [_host(f"embedding{_norm(config, ' and ')} of the token", "d numbers")]
    for layer in range(config.layers):
        steps += _layer_steps(f"layers.{layer}", config)
    steps.append(_host("state token: coder readout.coder", "firing rates"))
    steps.append(_host("action head, and its plasticity", "the action"))
    return {
        "format": FORMAT,
        "config": {field.name: getattr(config, field.name) for field in fields(config)},
        "tick_seconds": TICK_SECONDS,
        "ticks": config.ticks,
        "membranes": "start at 0 for every token and live for its ticks",
        "fires": "only at a tick with an input spike" if config.is_integer else "at any tick",
        "populations": {
            name: _entry(name, tensors)
            for name in sorted(key.removesuffix(".weight") for key in tensors)
            if name.endswith(POPULATIONS)
        },
        "steps_of_a_token": steps,
    }


def _entry(name: str, tensors: dict[str, NDArray[Any]]) -> dict[str, Any]:
    weight, units = tensors[f"{name}.weight"], _units(name, tensors)
    entry = {"file": f"{name}.nir", "neurons": len(weight), "inputs": weight.shape[1]}
    if units is None:
        return entry
    # Times these, weights and biases are the integers of the policy file.
    return entry | {"units": units.tolist()}


def _norm(config: ModelConfig, before: str) -> str:
    return f"{before}LayerNorm" if config.has_norms else ""


def _host(does: str, passes_on: str) -> dict[str, str]:
    return {"on": "host", "does": does, "passes_on": passes_on}


def _chip(population: str) -> dict[str, str]:
    return {"on": "chip", "population": population, "passes_on": "spikes"}


def _layer_steps(layer: str, config: ModelConfig) -> list[dict[str, str]]:
    phase = " and the phase spikes of the timestep" if config.has_phase else ""
    gates = "routing gates" if config.has_routing else "equal gates"
    attention = f"{layer}.attention"
    return [
        _host(f"LIF neurons of {layer}.coder under constant currents", f"spikes{phase}"),
        *(_chip(f"{attention}.{part}") for part in ("key", "value", "query")),
        _host(
            f"softmax attention over the window, {gates}, {attention}.output{_norm(config, ', ')}",
            "d numbers",
        ),
        _host(f"LIF neurons of {layer}.ffn.coder under constant currents", "spikes"),
        _chip(f"{layer}.ffn.hidden"),
        _host(f"{layer}.ffn.output of the spike counts{_norm(config, ', ')}", "d numbers"),
    ]
