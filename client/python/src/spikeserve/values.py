"""The arguments and results of calls as plain values. Arrays are NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.check import check, unmasked
from spikeserve.executed import Executed
from spikeserve.from_message import CONVERTERS, FromMessage, enum_name
from spikeserve.spaces import ActionSpace, action_space_from_wire
from spikeserve.wire import Message, message_class

# An index in [0, n) of a Discrete space, or float32 values in environment units of a Box.
Action = int | NDArray[np.float32]
# The same as an agent passes it.
ActionLike = int | np.integer[Any] | ArrayLike
ExecutedLike = ActionLike | Executed

CONVERTERS["ActionSpace"] = action_space_from_wire
CONVERTERS["SpikesByStage"] = lambda stages: {
    described.name: getattr(stages, described.name) for described in stages.DESCRIPTOR.fields
}


@dataclass(frozen=True)
class Feature(FromMessage):
    """One element of an observation or of a Box action, or one action of a Discrete."""

    name: str
    unit: str = ""  # in UCUM's spelling; "": unknown
    low: float | None = None  # the smallest value that the robot can have; None: unknown
    high: float | None = None
    frame: str = ""  # the frame of reference; "": unknown


@dataclass(frozen=True)
class WiringVerdict(FromMessage):
    """What the server believes about how the elements of the observation are wired."""

    cause: str  # EXCHANGED, SIGN, UNIT, STUCK, DELAY or DYNAMICS
    elements: tuple[int, ...]  # indices in the policy's order
    text: str  # for people
    evidence: float  # logarithm of the likelihood ratio between the cause and a correct wiring
    is_safe_action: bool  # the action is the policy's neutral action because of this verdict


@dataclass(frozen=True)
class Corrections(FromMessage):
    """How far a head is from operators: 0 if it acts as they do, up to 2 if they are opposite."""

    steps: int  # in which an operator acted
    disagreement: float  # on each step before it was learned from
    start_disagreement: float  # of the head that the session was opened with


@dataclass(frozen=True)
class Policy(FromMessage, message="PolicyInfo"):
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
    version_labels: tuple[str, ...]  # the labels of this version, for example "stable"
    traffic_percent: int | None  # of the new sessions; None: no traffic shares are set
    is_shadow: bool  # compared with the serving versions, and never answers
    observation_features: tuple[Feature, ...]  # (): the policy file names none
    action_features: tuple[Feature, ...]  # one per element of a Box, or per action of a Discrete
    rate_hz: float | None  # decisions per second in the training data; None: unknown
    rate_tolerance: float  # largest relative deviation from it
    checks_wiring: bool  # whether the server checks how sessions are wired
    rounding_loss: float | None  # share of the return that integers lost; None: not measured


@dataclass(frozen=True)
class Learning:
    """How a session learns. None or an empty string selects the default of the server."""

    scope: str = "SESSION"  # SESSION: a private copy of the action head; FLEET: the shared head
    rule: str = ""  # policy_gradient (default), hebbian, hebbian_action or corrections
    learning_rate: float | None = None
    trace_decay: float | None = None
    clip: float | None = None
    modulator: str = ""  # realized (default) or target
    max_drift: float | None = None  # largest |W - W_base| / |W_base|; SESSION only
    discount: float | None = None  # of the realized return per step, in [0, 1]
    guard_margin: float | None = None  # of the return guard, at least 0; SESSION only
    # How long an ended episode waits for Client.amend_episode before it is learned from as it is,
    # in [0, 3600] seconds. 0 (default): it is learned from at its end.
    verdict_seconds: float | None = None


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
    version_label: str = ""  # a label of the version, for example "canary"; requires version 0
    # Decides the traffic share of the session: equal keys get equal versions, for example the
    # serial number of a robot. "": the session id.
    routing_key: str = ""
    # The head to start from: W - W_base as Session.state and AdminClient.get_head return it. None:
    # the head of the policy.
    head_delta: ArrayLike | None = None
    # NONE: the session ends with its server. ASYNC, SYNC: it outlives it (docs/guides/fleet.md).
    # "": the default of the server.
    durability: str = ""
    # The names of the robot's elements in the order in which it sends them, and of the elements of
    # a Box action, or the actions of a Discrete, as it takes them. The client puts them in the
    # order of the policy; names that differ are refused. (): the policy's order, not checked.
    observation: Sequence[str] = ()
    action: Sequence[str] = ()
    observation_units: Sequence[str] = ()  # one per name, in UCUM's spelling; "": not checked
    action_units: Sequence[str] = ()
    rate_hz: float | None = None  # decisions per second of the robot, to be checked
    wiring: str = ""  # what follows from a verdict: COUNT, WARN or SAFE; "": the server's choice

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
            version_label=self.version_label,
            routing_key=self.routing_key,
            head_delta=() if self.head_delta is None else _flat(self.head_delta),
            durability=self.durability or "DURABILITY_DEFAULT",
            observation_names=self.observation,
            action_names=self.action,
            observation_units=self.observation_units,
            action_units=self.action_units,
            names_in_any_order=True,
            rate_hz=self.rate_hz,
            wiring=f"WIRING_{self.wiring or 'DEFAULT'}",
        )


@dataclass(frozen=True)
class Opening(FromMessage, message="OpenSessionResponse"):
    """The answer of the server to OpenSession."""

    policy: str
    version: int
    observation_size: int
    action_space: ActionSpace
    context_length: int  # timesteps
    target_return: float
    recording: str  # path below the --record_dir of the server; empty: not recorded
    durability: str  # NONE, ASYNC or SYNC
    observation_features: tuple[Feature, ...] = ()  # (): the policy file names none
    action_features: tuple[Feature, ...] = ()

    def check_action_space(self, space: ActionSpace) -> None:
        """ValueError if `space`, that of an environment, differs from that of the policy."""
        expected = f"{self.action_space} for policy {self.policy!r}"
        check(space == self.action_space, "action space", expected, space)


@dataclass(frozen=True)
class Stats(FromMessage, message="DecisionStats"):
    """The cost of one decision. Energies are estimates."""

    spikes: int
    synaptic_operations: int
    energy_joules: float  # by the energy model horowitz_45nm, for every policy
    compute_seconds: float
    spikes_by_stage: dict[str, int]
    accumulates: int
    multiply_accumulates: int
    attention_products: int
    horowitz_energy_joules: float  # equal to energy_joules
    unusual_observations: int  # elements of the observation far outside the training data
    membrane_updates: int  # LIF neurons times ticks
    coder_gains: int
    layer_norm_elements: int
    softmax_terms: int
    gate_products: int
    integer_multiply_accumulates: int  # those with an 8-bit weight
    spike_energy_joules: float | None  # by spike_5pj; None for a dense policy
    int_energy_joules: float | None  # by int_45nm; None for a policy in float32
    int_sram_energy_joules: float | None  # by int_sram_45nm; None for a policy in float32

    @property
    def leading_energy(self) -> tuple[str, float]:
        """Returns the energy model that leads and its joules: with memory, where it applies."""
        if self.int_sram_energy_joules is None:
            return "horowitz_45nm", self.energy_joules
        return "int_sram_45nm", self.int_sram_energy_joules


@dataclass(frozen=True)
class Hold(FromMessage):
    """What an operator has put on a session: its robot stays at its safe action."""

    id: str
    reason: str  # for people


@dataclass(frozen=True)
class Decision(FromMessage, message="ActResponse"):
    """The answer to one observation."""

    step: int
    action: Action
    action_probabilities: NDArray[np.float32] | None  # [n]; None for a Box
    return_to_go: float  # the input of the model at this step
    stats: Stats
    durable_decision: int  # decisions of the session that its store has acknowledged
    durable_episode: int  # episodes of the session whose end its store has acknowledged
    wiring: WiringVerdict | None = None  # None: nothing speaks against the wiring
    # Who chose the action: POLICY, OPERATOR, SAFETY_LAYER (the neutral action, because of the
    # wiring) or HOLD.
    source: str = "POLICY"
    operator_id: str = ""  # source OPERATOR only
    hold: Hold | None = None  # what holds the session; None: nothing

    @classmethod
    def _others(cls, message: Message) -> dict[str, Any]:
        action = message.action
        discrete = action.WhichOneof("kind") == "discrete"
        values = action.discrete if discrete else np.asarray(action.continuous.values, np.float32)
        probabilities = np.asarray(message.action_probabilities, np.float32)
        return {
            "action": values,
            "action_probabilities": probabilities if discrete else None,
            "source": enum_name(message.source, "kind") if message.HasField("source") else "POLICY",
            "operator_id": message.source.operator_id,
        }


@dataclass(frozen=True)
class LearningSummary(FromMessage):
    """What a session that learns learned from an episode."""

    updates: int
    rejected_updates: int  # because they were not finite
    head_drift: float  # |W - W_base| / |W_base| after the episode; FLEET: of the shared head
    modulator_mean: float  # running mean of the returns that followed the decisions
    modulator_std: float
    rolled_back: bool  # the guard restored the last good head
    watched_return: float  # of the last complete window of episodes that the guard judged


@dataclass(frozen=True)
class EpisodeSummary(FromMessage, message="EndEpisodeResponse"):
    """The totals of an episode that has ended."""

    episode_return: float
    steps: int
    spikes: int
    energy_joules: float  # an estimate by horowitz_45nm
    learning: LearningSummary | None = None  # None: the session does not learn
    recording: str = "NOT_RECORDED"  # or QUEUED (in memory), or STORED (on the disk)
    # Steps at the begin of the episode that the summary does not have. Only a pilot knows them: its
    # session was lost, and a new one took its place.
    lost_steps: int = 0
    awaits_verdict: bool = False  # Client.amend_episode returns `learning`


@dataclass(frozen=True)
class AmendedEpisode(FromMessage, message="AmendEpisodeResponse"):
    """An episode after its verdict."""

    episode_return: float  # the sum of the rewards, as amended
    learning: LearningSummary | None = None  # None: the episode did not wait for its verdict
    recording: str = "NOT_RECORDED"  # STORED: the recording has the verdict


@dataclass(frozen=True)
class SessionState(FromMessage, message="GetSessionResponse"):
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
    modulator_mean: float  # running mean of the returns that followed the decisions
    modulator_std: float
    rollbacks: int  # of the head that the session learns
    missing_rewards: int  # left out by requests, and counted as 0
    # W - W_base of the head that makes the next decision, row-major. None: it was not asked for, or
    # the session plays on the head of the policy.
    head_delta: NDArray[np.float32] | None
    wiring: WiringVerdict | None  # None: nothing speaks against the wiring
    corrections: Corrections | None  # None: another rule, or no operator has acted

    @classmethod
    def _others(cls, message: Message) -> dict[str, Any]:
        delta = np.asarray(message.head_delta, np.float32)
        return {"head_delta": delta if delta.size else None}


FLATTEN_HINT = "gymnasium.wrappers.FlattenObservation makes one of a Dict or Tuple observation"


def _flat(values: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(values, np.float32).ravel()


def action_to_wire(action: ExecutedLike | None) -> Message | None:
    """Converts an executed action. None: the action was executed as answered.

    An integer is an index of a Discrete space; an array of one dimension is an action of a Box.
    ValueError for anything else.
    """
    if isinstance(action, Executed):
        check(action.action is not None, "executed_action", "an action with a source", "None")
        action = action.action
    if action is None:
        return None
    array = np.asarray(unmasked(action, "executed_action"))
    make = message_class("Action")
    if array.ndim == 0 and np.issubdtype(array.dtype, np.integer):
        return make(discrete=int(array))
    expected = "an integer or an array of one dimension"
    received = action if array.ndim == 0 else f"shape {array.shape}"
    check(array.ndim == 1, "executed_action", expected, received)
    return make(continuous={"values": np.asarray(array, np.float32)})


def observation_array(observation: ArrayLike) -> NDArray[np.float32]:
    """Converts an observation to float32. ValueError if it does not have exactly one dimension."""
    flat = not isinstance(observation, dict | tuple) or all(np.ndim(x) == 0 for x in observation)
    kind = type(observation).__name__
    check(flat and kind != "dict", "observation", f"one array ({FLATTEN_HINT})", f"a {kind}")
    array = np.asarray(unmasked(observation, "observation"), np.float32)
    check(array.ndim == 1, "observation", "one dimension", f"shape {array.shape}")
    return array
