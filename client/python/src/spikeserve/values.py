"""The arguments and results of calls as plain values. Arrays are NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.check import check
from spikeserve.spaces import ActionSpace, action_space_from_wire
from spikeserve.wire import Message, message_class

# An index in [0, n) of a Discrete space, or float32 values in environment units of a Box.
Action = int | NDArray[np.float32]
# The same as an agent passes it.
ActionLike = int | np.integer[Any] | ArrayLike


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
    training_return: float | None  # mean return that the policy file records; None: not recorded
    environment: str  # the id in Gymnasium
    mode: str

    @classmethod
    def from_wire(cls, message: Message) -> Policy:
        """Converts a PolicyInfo."""
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
    """How a session learns. None or an empty string selects the default of the server."""

    scope: str = "SESSION"  # SESSION: a private copy of the action head; FLEET: the shared head
    rule: str = ""  # policy_gradient (default) or hebbian
    learning_rate: float | None = None
    trace_decay: float | None = None
    clip: float | None = None
    modulator: str = ""  # realized (default) or target


@dataclass(frozen=True)
class SessionOptions:
    """The settings of a new session. None selects the default of the policy or the server."""

    version: int = 0  # 0: the default version
    target_return: float | None = None
    seed: int = 0
    sample: bool = False  # True: sample the action; False: take the most probable action
    temperature: float | None = None  # of `sample`, more than 0
    learning: Learning | None = None  # None: the action head does not change
    labels: dict[str, str] = field(default_factory=dict)
    record: bool = False  # write the episodes to the --record_dir of the server

    def to_wire(self, policy: str) -> Message:
        """Returns the OpenSessionRequest for `policy`."""
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
    """The answer of the server to OpenSession."""

    policy: str
    version: int
    observation_size: int
    action_space: ActionSpace
    context_length: int  # timesteps
    target_return: float
    recording: str  # path below the --record_dir of the server; empty: not recorded

    @classmethod
    def from_wire(cls, message: Message) -> Opening:
        """Converts an OpenSessionResponse."""
        return cls(
            policy=message.policy,
            version=message.version,
            observation_size=message.observation_size,
            action_space=action_space_from_wire(message.action_space),
            context_length=message.context_length,
            target_return=message.target_return,
            recording=message.recording,
        )

    def check_action_space(self, space: ActionSpace) -> None:
        """ValueError if `space`, that of an environment, differs from that of the policy."""
        expected = f"{self.action_space} for policy {self.policy!r}"
        check(space == self.action_space, "action space", expected, space)


@dataclass(frozen=True)
class Stats:
    """The cost of one decision. Energies are estimates."""

    spikes: int
    synaptic_operations: int
    energy_joules: float  # 5 pJ a spike; a dense policy has no spikes and uses horowitz_45nm
    compute_seconds: float
    spikes_by_stage: dict[str, int]
    accumulates: int
    multiply_accumulates: int
    attention_products: int
    horowitz_energy_joules: float

    @classmethod
    def from_wire(cls, message: Message) -> Stats:
        """Converts a DecisionStats."""
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
    action_probabilities: NDArray[np.float32] | None  # [n]; None for a Box
    return_to_go: float  # the input of the model at this step
    stats: Stats

    @classmethod
    def from_wire(cls, message: Message) -> Decision:
        """Converts an ActResponse."""
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
    """The totals of an episode that has ended."""

    episode_return: float
    steps: int
    spikes: int
    energy_joules: float  # estimate

    @classmethod
    def from_wire(cls, message: Message) -> EpisodeSummary:
        """Converts an EndEpisodeResponse."""
        return cls(message.episode_return, message.steps, message.spikes, message.energy_joules)


@dataclass(frozen=True)
class SessionState:
    """The state of a session on the server."""

    session_id: str
    policy: str
    version: int
    episode: int  # counts from 0
    step: int  # the step expected next
    episode_return: float
    return_to_go: float
    target_return: float
    trace_norm: float  # Frobenius norm of the eligibility trace
    head_drift: float  # |W - W_base| / |W_base| of the action head
    spikes: int  # since the session was opened
    energy_joules: float  # since the session was opened, estimate
    decisions: int  # since the session was opened
    labels: dict[str, str]

    @classmethod
    def from_wire(cls, message: Message) -> SessionState:
        """Converts a GetSessionResponse."""
        values = {name: getattr(message, name) for name in cls.__dataclass_fields__}
        return cls(**(values | {"labels": dict(message.labels)}))


def action_to_wire(action: ActionLike | None) -> Message | None:
    """Converts an executed action. None: the action was executed as answered.

    An integer is an index of a Discrete space; an array of one dimension is an action of a Box.
    ValueError for anything else.
    """
    if action is None:
        return None
    array = np.asarray(action)
    make = message_class("Action")
    if array.ndim == 0 and np.issubdtype(array.dtype, np.integer):
        return make(discrete=int(array))
    expected = "an integer or an array of one dimension"
    received = action if array.ndim == 0 else f"shape {array.shape}"
    check(array.ndim == 1, "executed_action", expected, received)
    return make(continuous={"values": np.asarray(array, np.float32)})


def observation_array(observation: ArrayLike) -> NDArray[np.float32]:
    """Converts an observation to float32. ValueError if it does not have exactly one dimension."""
    array = np.asarray(observation, np.float32)
    check(array.ndim == 1, "observation", "one dimension", f"shape {array.shape}")
    return array
