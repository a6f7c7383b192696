"""`Explanation`: the last decision of a session from the inside. Arrays are NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikeserve.values import Decision, enum_name
from spikeserve.wire import Message


@dataclass(frozen=True)
class Token:
    """One token of the input sequence of the model."""

    kind: str  # RETURN_TO_GO, STATE or ACTION
    timestep: int  # within the episode

    @classmethod
    def from_wire(cls, message: Message) -> Token:
        """Converts a Token of the wire contract."""
        return cls(enum_name(message, "kind"), message.timestep)


@dataclass(frozen=True)
class SpikeRaster:
    """The spikes that one neuron population emitted for one token, as a scatter plot takes them."""

    stage: str  # a key of Stats.spikes_by_stage
    layer: int | None  # None for the stages phase and readout
    token: Token
    population: int  # neurons
    ticks: NDArray[np.int32]  # of each spike, ascending
    neurons: NDArray[np.int32]  # of each spike

    @classmethod
    def from_wire(cls, message: Message) -> SpikeRaster:
        """Converts a SpikeRaster of the wire contract."""
        return cls(
            stage=message.stage,
            layer=message.layer if message.HasField("layer") else None,
            token=Token.from_wire(message.token),
            population=message.population,
            ticks=np.asarray(message.ticks, np.int32),
            neurons=np.asarray(message.neurons, np.int32),
        )


@dataclass(frozen=True)
class Attention:
    """The attention weights of the state token of the decision in one layer."""

    layer: int
    keys: tuple[Token, ...]
    weights: NDArray[np.float32]  # [ticks, heads, keys]; they add up to 1 over the keys

    @classmethod
    def from_wire(cls, message: Message) -> Attention:
        """Converts an Attention of the wire contract."""
        keys = tuple(Token.from_wire(key) for key in message.keys)
        weights = np.asarray(message.weights, np.float32)
        return cls(message.layer, keys, weights.reshape(message.ticks, -1, len(keys)))


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
class Explanation:
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
    def from_wire(cls, message: Message) -> Explanation:
        """Converts an ExplainResponse."""
        values = {name: getattr(message, name) for name in cls.__dataclass_fields__}
        for name in ("observation", "logits", "readout"):
            values[name] = np.asarray(values[name], np.float32)
        values["answer"] = Decision.from_wire(message.answer)
        values["rasters"] = tuple(map(SpikeRaster.from_wire, message.rasters))
        values["attention"] = tuple(map(Attention.from_wire, message.attention))
        values["routing"] = tuple(
            RoutingGates.from_wire(gates, message.ticks) for gates in message.routing
        )
        return cls(**values)
