"""The shape and the choices of one SNN-DT, as stored in a policy file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np


@dataclass(frozen=True)
class ModelConfig:
    """The `config` of a policy file. ValueError names the field, what was expected and what came.

    Symbols: d hidden size, H heads, L layers, T ticks, N context in timesteps.
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
    coder: str = "lif"  # or bernoulli
    phase_clock: str = "timestep"  # or window
    merge: str = "sum"  # or concat
    gate: str = "softmax"  # or sigmoid

    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {
        "mode": ("baseline", "pos", "route", "full", "dense"),
        "coder": ("lif", "bernoulli"),
        "phase_clock": ("timestep", "window"),
        "merge": ("sum", "concat"),
        "gate": ("softmax", "sigmoid"),
    }
    # The largest sizes that the server's reader takes.
    LIMITS: ClassVar[dict[str, int]] = {
        "hidden_size": 4096,
        "heads": 64,
        "layers": 64,
        "ticks": 256,
        "context": 4096,
        "routing_hidden_size": 4096,
        "ffn_size": 16384,
    }

    def __post_init__(self) -> None:
        for field, names in self.CHOICES.items():
            value = getattr(self, field)
            if value not in names:
                raise ValueError(f"{field}: expected one of {', '.join(names)}, got {value!r}")
        for field, limit in self.LIMITS.items():
            value = getattr(self, field)
            if type(value) is not int or not 1 <= value <= limit:
                raise ValueError(f"{field}: expected an integer from 1 to {limit}, got {value!r}")
        if self.hidden_size % self.heads != 0:
            raise ValueError(
                f"hidden_size: expected a multiple of heads = {self.heads}, got {self.hidden_size}"
            )
        if not 0 <= self.membrane_decay <= 1:
            raise ValueError(f"membrane_decay: expected 0 to 1, got {self.membrane_decay}")
        if not 0 < np.float32(self.threshold) < np.inf:
            raise ValueError(f"threshold: expected a positive finite number, got {self.threshold}")

    @property
    def is_dense(self) -> bool:
        """An ordinary decision transformer, for comparison."""
        return self.mode == "dense"

    @property
    def has_phase(self) -> bool:
        """With phase spikes."""
        return self.mode in ("pos", "full")

    @property
    def has_routing(self) -> bool:
        """With dendritic routing."""
        return self.mode in ("route", "full")

    @property
    def attention_inputs(self) -> int:
        """Inputs of the query, key and value projections."""
        return self.hidden_size + (self.heads if self.has_phase else 0)

    @property
    def merged_size(self) -> int:
        """Inputs of the attention's output projection."""
        side_by_side = self.is_dense or self.merge == "concat"
        return self.hidden_size if side_by_side else self.hidden_size // self.heads
