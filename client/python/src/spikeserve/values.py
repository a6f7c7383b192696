"""What calls take and return, as plain values. NumPy where there are arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.spaces import ActionSpace, action_space_from_wire
from spikeserve.wire import Message, message_class

# An index in [0, n) for a Discrete space; float32 values in environment units for a Box.
Action = int | NDArray[np.float32]


@dataclass(frozen=True)
class Policy:
    """One version of a policy that the server serves."""

    name: str
    version: int
    is_default: bool
    observation_size: int
    action_space: ActionSpace
    context_length: int  # timesteps
    target_return: float
    training_return: float | None  # mean return of the evaluation in the policy file, if any
    environment: str  # Gymnasium's id
    mode: str

    @classmethod
    def from_wire(cls, message: Message) -> Policy:
        """From a PolicyInfo."""
        has_return = message.HasField("training_return")
        return cls(
            name=message.name,
            version=message.version,
            is_default=message.is_default,
            observation_size=message.observation_size,
            action_space=action_space_from_wire(message.action_space),
            context_length=message.context_length,
            target_return=message.target_return,
            training_return=message.training_return if has_return else None,
            environment=message.environment,
            mode=message.mode,
        )


@dataclass(frozen=True)
class Learning:
    """How a session learns; what is None is the server's default."""

    scope: str = "SESSION"  # a private copy of the action head; or FLEET, the shared one
    rule: str = ""  # policy_gradient (default) or hebbian
    learning_rate: float | None = None
    trace_decay: float | None = None
    clip: float | None = None
    modulator: str = ""  # target (default) or realized


@dataclass(frozen=True)
class SessionOptions:
    """What a session is opened with; what is None is the policy's or the server's default."""

    version: int = 0  # 0: the default version
    target_return: float | None = None
    seed: int = 0
    sample: bool = False  # draw the action instead of taking the best
    temperature: float | None = None  # with `sample` only
    learning: Learning | None = None  # None: frozen
    labels: dict[str, str] = field(default_factory=dict)
    record: bool = False  # keep the episodes below the server's --record_dir

    def to_wire(self, policy: str) -> Message:
        """As an OpenSessionRequest for `policy`."""
        return message_class("OpenSessionRequest")(
            policy=policy,
            version=self.version,
            target_return=self.target_return,
            seed=self.seed,
            action_selection="SAMPLE" if self.sample else "GREEDY",
            temperature=self.temperature,
            learning=None if self.learning is None else vars(self.learning),
            labels=self.labels,
            record=self.record,
        )


@dataclass(frozen=True)
class Opening:
    """What the server said when it opened a session."""

    policy: str
    version: int
    observation_size: int
    action_space: ActionSpace
    context_length: int
    target_return: float
    recording: str  # below the server's --record_dir; empty: not recorded

    @classmethod
    def from_wire(cls, message: Message) -> Opening:
        """From an OpenSessionResponse."""
        return cls(
            policy=message.policy,
            version=message.version,
            observation_size=message.observation_size,
            action_space=action_space_from_wire(message.action_space),
            context_length=message.context_length,
            target_return=message.target_return,
            recording=message.recording,
        )


@dataclass(frozen=True)
class Stats:
    """What one decision spent. Energies are estimates."""

    spikes: int
    synaptic_operations: int
    energy_joules: float  # 5 pJ a spike; of a dense policy, which has none, horowitz_45nm
    compute_seconds: float
    spikes_by_stage: dict[str, int]
    accumulates: int
    multiply_accumulates: int
    attention_products: int
    horowitz_energy_joules: float

    @classmethod
    def from_wire(cls, message: Message) -> Stats:
        """From a DecisionStats."""
        stages = message.spikes_by_stage
        return cls(
            spikes=message.spikes,
            synaptic_operations=message.synaptic_operations,
            energy_joules=message.energy_joules,
            compute_seconds=message.compute_seconds,
            spikes_by_stage={f.name: getattr(stages, f.name) for f in stages.DESCRIPTOR.fields},
            accumulates=message.accumulates,
            multiply_accumulates=message.multiply_accumulates,
            attention_products=message.attention_products,
            horowitz_energy_joules=message.horowitz_energy_joules,
        )


@dataclass(frozen=True)
class Decision:
    """The answer to one observation."""

    step: int
    action: Action
    action_probabilities: NDArray[np.float32] | None  # [n], of a Discrete space
    return_to_go: float  # what the decision was conditioned on
    stats: Stats

    @classmethod
    def from_wire(cls, message: Message) -> Decision:
        """From an ActResponse."""
        discrete = message.action.WhichOneof("kind") == "discrete"
        probabilities = np.asarray(message.action_probabilities, np.float32)
        return cls(
            step=message.step,
            action=message.action.discrete
            if discrete
            else np.asarray(message.action.continuous.values, np.float32),
            action_probabilities=probabilities if discrete else None,
            return_to_go=message.return_to_go,
            stats=Stats.from_wire(message.stats),
        )


@dataclass(frozen=True)
class EpisodeSummary:
    """An episode that has ended."""

    episode_return: float
    steps: int
    spikes: int
    energy_joules: float  # estimate

    @classmethod
    def from_wire(cls, message: Message) -> EpisodeSummary:
        """From an EndEpisodeResponse."""
        return cls(message.episode_return, message.steps, message.spikes, message.energy_joules)


@dataclass(frozen=True)
class SessionState:
    """The server's view of a session."""

    session_id: str
    policy: str
    version: int
    episode: int  # counts from 0
    step: int  # the step expected next
    episode_return: float
    return_to_go: float
    target_return: float
    trace_norm: float
    head_drift: float
    spikes: int  # this and what follows: over the session's life
    energy_joules: float
    decisions: int
    labels: dict[str, str]

    @classmethod
    def from_wire(cls, message: Message) -> SessionState:
        """From a GetSessionResponse."""
        values = {name: getattr(message, name) for name in cls.__dataclass_fields__}
        return cls(**(values | {"labels": dict(message.labels)}))


def observation_array(observation: ArrayLike) -> NDArray[np.float32]:
    """`observation` as a vector of float32. ValueError if it has not one dimension."""
    array = np.asarray(observation, np.float32)
    if array.ndim != 1:
        raise ValueError(f"observation: expected one dimension, got shape {array.shape}")
    return array
