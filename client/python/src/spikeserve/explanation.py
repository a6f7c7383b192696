"""`Explanation`: the last decision of a session from the inside. Arrays are NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.from_message import FromMessage
from spikeserve.values import Decision
from spikeserve.wire import Message


@dataclass(frozen=True)
class Token(FromMessage):
    """One token of the input sequence of the model."""

    kind: str  # RETURN_TO_GO, STATE or ACTION
    timestep: int  # within the episode


@dataclass(frozen=True)
class SpikeRaster(FromMessage):
    """The spikes that one neuron population emitted for one token, as a scatter plot takes them."""

    stage: str  # a key of Stats.spikes_by_stage
    layer: int | None  # None for the stages phase and readout
    token: Token
    population: int  # neurons
    ticks: NDArray[np.int32]  # of each spike, ascending
    neurons: NDArray[np.int32]  # of each spike

    @classmethod
    def _others(cls, message: Message) -> dict[str, Any]:
        return {name: np.asarray(getattr(message, name), np.int32) for name in ("ticks", "neurons")}


@dataclass(frozen=True)
class Attention(FromMessage):
    """The attention weights of the state token of the decision in one layer."""

    layer: int
    keys: tuple[Token, ...]
    weights: NDArray[np.float32]  # [ticks, heads, keys]; they add up to 1 over the keys

    @classmethod
    def _others(cls, message: Message) -> dict[str, Any]:
        weights = np.asarray(message.weights, np.float32)
        return {"weights": weights.reshape(message.ticks, -1, len(message.keys))}


@dataclass(frozen=True)
class RoutingGates:
    """The routing gates of one layer."""

    layer: int
    tokens: tuple[Token, ...]
    gates: NDArray[np.float32]  # [tokens, ticks, heads]

    @classmethod
    def from_wire(cls, message: Message, ticks: int) -> RoutingGates:
        """Converts a RoutingGates of the wire contract."""
        tokens = tuple(Token.from_wire(token) for token in message.tokens)
        gates = np.asarray(message.gates, np.float32)
        return cls(message.layer, tokens, gates.reshape(len(tokens), ticks, -1))


@dataclass(frozen=True)
class Explanation(FromMessage, message="ExplainResponse"):
    """The last decision of a session: its spikes, attention, routing gates and logits."""

    session_id: str
    policy: str
    version: int
    mode: str
    layers: int
    heads: int
    ticks: int  # per token
    episode: int  # counts from 0
    observation: NDArray[np.float32]
    answer: Decision  # as it was sent
    logits: NDArray[np.float32]  # of the action head that made the decision
    readout: NDArray[np.float32]  # [hidden size]: firing rates, the input of the action head
    rasters: tuple[SpikeRaster, ...]  # they add up to answer.stats.spikes_by_stage
    attention: tuple[Attention, ...]  # one per layer
    routing: tuple[RoutingGates, ...]  # one per layer; empty for a mode without routing

    @classmethod
    def _others(cls, message: Message) -> dict[str, Any]:
        arrays = ("observation", "logits", "readout")
        values = {name: np.asarray(getattr(message, name), np.float32) for name in arrays}
        routing = (RoutingGates.from_wire(gates, message.ticks) for gates in message.routing)
        return {**values, "routing": tuple(routing)}
