"""The configuration of one SNN-DT model, as stored in a policy file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikeserve.check import check


@dataclass(frozen=True)
class ModelConfig:
    """The `config` of a policy file.

    Symbols: d hidden size, H heads, L layers, T ticks, N context in timesteps. ValueError names the
    field, the expected value and the received value.
    """

    mode: str = "full"  # baseline, pos, route, full or dense
    hidden_size: int = 128  # d
    heads: int = 4  # H
    layers: int = 2  # L
    ticks: int = 10  # T
    context: int = 20  # N
    routing_hidden_size: int = 16
    ffn_size: int = 512  # 4d
    membrane_decay: float = 0.95
    threshold: float = 1.0
    coder: str = "lif"
    phase_clock: str = "timestep"  # or window
    merge: str = "sum"  # or concat
    gate: str = "softmax"  # or sigmoid
    arithmetic: str = "float32"  # or integer, of everything but the head
    norm: str = "layer"  # after each addition to the residual stream; or none
    # Whether the state token also contains the change of the observation since the last timestep.
    observation_changes: bool = False
    # Whether attention adds a learned number to a score, by head and distance in tokens.
    # The following belong to arithmetic integer (docs/design/integer.md).
    leak: str = "shift"
    attention: str = "shiftmax_by_tick"
    input_fraction: int = 8  # fraction bits of the embeddings' inputs
    residual_fraction: int = 10  # fraction bits of the residual stream

    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {
        "mode": ("baseline", "pos", "route", "full", "dense"),
        "coder": ("lif",),
        "phase_clock": ("timestep", "window"),
        "merge": ("sum", "concat"),
        "gate": ("softmax", "sigmoid"),
        "arithmetic": ("float32", "integer"),
        "norm": ("layer", "none"),
        "leak": ("shift",),
        "attention": ("shiftmax_by_tick", "shiftmax"),
    }
    # The largest sizes that the server accepts.
    LIMITS: ClassVar[dict[str, int]] = {
        "hidden_size": 4096,
        "heads": 64,
        "layers": 64,
        "ticks": 256,
        "context": 4096,
        "routing_hidden_size": 4096,
        "ffn_size": 16384,
        "input_fraction": 14,
        "residual_fraction": 14,
    }

    def __post_init__(self) -> None:
        for field, names in self.CHOICES.items():
            value = getattr(self, field)
            check(value in names, field, f"one of {', '.join(names)}", repr(value))
        for field, limit in self.LIMITS.items():
            value = getattr(self, field)
            fits = type(value) is int and 1 <= value <= limit
            check(fits, field, f"an integer from 1 to {limit}", repr(value))
        changes = self.observation_changes
        check(isinstance(changes, bool), "observation_changes", "True or False", repr(changes))
        divides = self.hidden_size % self.heads == 0
        check(divides, "hidden_size", f"a multiple of heads = {self.heads}", self.hidden_size)
        check(0 <= self.membrane_decay <= 1, "membrane_decay", "0 to 1", self.membrane_decay)
        fits = bool(0 < np.float32(self.threshold) < np.inf)
        check(fits, "threshold", "a positive finite number", self.threshold)
        check(self.has_norms or not self.is_dense, "norm", "layer in mode dense", repr(self.norm))
        if self.is_integer and not self.is_dense:
            check(self.ticks <= 255, "ticks", "at most 255 with arithmetic integer", self.ticks)
            fits = self.membrane_decay in [1 - m / 256 for m in range(1, 129)]
            expected = "1 - m / 256 for an m from 1 to 128 in integers"
            check(fits, "membrane_decay", expected, self.membrane_decay)

    @property
    def is_integer(self) -> bool:
        """Returns whether everything but the action head is computed with integers."""
        return self.arithmetic == "integer"

    @property
    def is_dense(self) -> bool:
        """Returns whether the model is a decision transformer without spikes, for comparison."""
        return self.mode == "dense"

    @property
    def has_norms(self) -> bool:
        """Returns whether the model has LayerNorms."""
        return self.norm == "layer"

    @property
    def has_phase(self) -> bool:
        """Returns whether the model has phase spikes."""
        return self.mode in ("pos", "full")

    @property
    def has_routing(self) -> bool:
        """Returns whether the model has dendritic routing."""
        return self.mode in ("route", "full")

    @property
    def attention_inputs(self) -> int:
        """Returns the input size of the query, key and value projections."""
        return self.hidden_size + (self.heads if self.has_phase else 0)

    @property
    def merged_size(self) -> int:
        """Returns the input size of the output projection of the attention."""
        concatenated = self.is_dense or self.merge == "concat"
        return self.hidden_size if concatenated else self.hidden_size // self.heads
