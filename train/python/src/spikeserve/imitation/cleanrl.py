"""Loads experts that CleanRL's scripts saved with --save-model.

A `.cleanrl_model` file holds the tensors of a network without its activations, so every script
needs a reader of its own.
"""

from __future__ import annotations

import pathlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.flat_spaces import FlatEnvironment

SUFFIX = ".cleanrl_model"


@dataclass(frozen=True)
class _Network:
    """The name and the activation of a script's torch.nn.Sequential of linear layers."""

    name: str
    activation: Callable[[NDArray[np.float32]], NDArray[np.float32]]


def _relu(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.maximum(values, 0)


# The greedy action is the largest output: a logit of PPO, a value of DQN.
_SCRIPTS = {"ppo": _Network("actor", np.tanh), "dqn": _Network("network", _relu)}


def load_cleanrl(script: str, path: str) -> Callable[[FlatEnvironment], Any]:
    """Returns the greedy policy of a file of ppo.py or dqn.py. ValueError if it cannot be used.

    Other scripts are refused: those for continuous actions normalise the observations by moments
    that they do not save.
    """
    check(script in _SCRIPTS, "expert", "ppo or dqn before a file of CleanRL", script)
    check(pathlib.Path(path).is_file(), "expert", "a file of CleanRL", path)
    try:
        import torch
    except ImportError as error:
        raise ValueError(f"expert: expected the package torch for {path}, received none") from error
    network = _SCRIPTS[script]
    stored = torch.load(path, map_location="cpu", weights_only=True)
    layers = _layers(stored, network.name)
    check(bool(layers), "expert", f"a file of {script}.py with `{network.name}.0.weight`", path)

    def act(environment: FlatEnvironment) -> int:
        values = np.asarray(environment.native_observation, np.float32).ravel()
        for index, (weight, bias) in enumerate(layers):
            values = weight @ (network.activation(values) if index > 0 else values) + bias
        return int(np.argmax(values))

    return act


def _layers(stored: dict[str, Any], name: str) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """Returns weight [out, in] and bias [out] of the linear layers, in order."""
    matches = [re.fullmatch(rf"{name}\.(\d+)\.weight", key) for key in stored]
    indices = sorted(int(match.group(1)) for match in matches if match)
    return [
        (np.asarray(stored[f"{name}.{i}.weight"]), np.asarray(stored[f"{name}.{i}.bias"]))
        for i in indices
    ]
