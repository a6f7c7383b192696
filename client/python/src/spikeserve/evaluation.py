"""`evaluate` plays a Gymnasium environment with a served policy and reports returns and costs."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import grpc
import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check, names_like
from spikeserve.client import Client
from spikeserve.distance import Arrivals, Distance
from spikeserve.errors import SessionLostError, SpikeserveError
from spikeserve.session import Session
from spikeserve.spaces import as_action_space, check_observation_space
from spikeserve.values import Decision, EpisodeSummary, Policy, SessionOptions

_TRIES = 3  # of an episode whose session is lost


@dataclass
class EnergyMeter:
    """The estimated energy of decisions, by the model that leads for their policy."""

    model: str = ""
    joules: float = 0.0
    decisions: int = 0

    def add(self, decision: Decision) -> Decision:
        """Counts a decision, and returns it."""
        self.model, joules = decision.stats.leading_energy
        self.joules += joules
        self.decisions += 1
        return decision


@dataclass(frozen=True)
class Evaluation:
    """The result of `evaluate`. `episodes` are in the order of their seeds."""

    env_id: str
    policy: str
    version: int
    episodes: list[EpisodeSummary]
    energy: EnergyMeter = field(default_factory=EnergyMeter)  # also of episodes played again

    @property
    def returns(self) -> NDArray[np.float64]:
        """Returns the return of each episode."""
        return np.array([episode.episode_return for episode in self.episodes])

    @property
    def mean_return(self) -> float:
        """Returns the mean of the returns."""
        return float(np.mean(self.returns))

    @property
    def std_return(self) -> float:
        """Returns the standard deviation of the returns."""
        return float(np.std(self.returns))

    @property
    def decisions(self) -> int:
        """Returns the decisions of all episodes."""
        return sum(episode.steps for episode in self.episodes)

    @property
    def spikes_per_decision(self) -> float:
        """Returns the mean spikes of a decision over all episodes."""
        return sum(episode.spikes for episode in self.episodes) / self.decisions

    @property
    def energy_joules_per_decision(self) -> float:
        """Returns the mean energy of a decision, an estimate by `energy.model`."""
        return self.energy.joules / self.energy.decisions

    def __str__(self) -> str:
        return (
            f"{self.policy}/{self.version} plays {self.env_id}: return {self.mean_return:.1f} "
            f"± {self.std_return:.1f} over {len(self.episodes)} episodes, "
            f"{self.spikes_per_decision:.0f} spikes and "
            f"{self.energy_joules_per_decision * 1e9:.2f} nJ (estimated by {self.energy.model}) "
            "a decision"
        )


class EvaluationStoppedError(SpikeserveError):
    """A call failed in the middle of an evaluation. `evaluation` holds the episodes before it."""

    def __init__(self, error: SpikeserveError, evaluation: Evaluation, episodes: int) -> None:
        ended = len(evaluation.episodes)
        summary = f"stopped after {ended} of {episodes} episodes: {evaluation}"
        super().__init__(error.call, error.code, error.message, error.retry_after)
        self.args = (f"{error}\n{summary}",)
        self.evaluation = evaluation


def evaluate(
    env: Any,
    policy: str | None = None,
    *,
    server: str | Client | None = None,
    episodes: int = 20,
    seed: int = 0,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[Callable[[Any], Any]] = (),
    version: int | None = None,
    options: SessionOptions | None = None,
    delay: int = 0,
    jitter: int = 0,
    loss: float = 0.0,
) -> Evaluation:
    """Plays episodes of a Gymnasium environment, with the most probable actions by default.

    `env` is an id of Gymnasium, also with the module that registers it ("quad:MyQuad-v0"), or an
    environment. `env_kwargs` are the arguments of gymnasium.make for an id; `wrappers` are applied
    in order. Its spaces are mapped to those of a policy (`spikeserve.flat_spaces`). Episode i is
    reset with seed `seed` + i.

    `server` is an address, None for that of Client, or a client with its own options. Without
    `policy`, plays the served policy that was made for this environment. `options` are those of
    the session; `version` replaces its version.

    With `delay`, each decision is executed that many steps after its observation, and up to
    `jitter` steps later; the share `loss` of the decisions never arrives. Meanwhile the last action
    is executed, which the policy is told.

    An episode whose session was lost is played again in a new session, unless the session learns.
    If a call fails after some episodes, raises EvaluationStoppedError with the result so far.
    LookupError if no such policy is served. ValueError if `episodes` is less than 1, or if a space
    of the policy differs from that of the environment.
    """
    from spikeserve.flat_spaces import FlatEnvironment  # needs Gymnasium, as an environment does

    check(episodes >= 1, "episodes", "at least 1", episodes)
    distance = Distance(delay, jitter, loss)
    settings = options or SessionOptions()
    if version is not None:
        settings = replace(settings, version=version)
    with contextlib.ExitStack() as stack:
        client = server if isinstance(server, Client) else stack.enter_context(Client(server))
        native = _make_environment(env, env_kwargs, wrappers)
        if isinstance(env, str):
            stack.callback(native.close)
        environment = FlatEnvironment(native)
        env_id = str(native if native.spec is None else native.spec.id)
        name = policy or choose_policy(client.list_policies(), env_id).name
        reopen = settings.learning is None  # a new session would have lost the learned head
        session = stack.enter_context(client.open_session(name, settings, reopen=reopen))
        opening = session.opening
        assert opening is not None
        opening.check_action_space(as_action_space(environment.action_space))
        check_observation_space(environment.observation_space, opening.observation_size, name)
        result = Evaluation(env_id, name, opening.version, [])
        play = functools.partial(_play, environment, session, distance, result.energy)
        _play_all(result, play, range(seed, seed + episodes))
        return result


def _play_all(result: Evaluation, play: Callable[[int], EpisodeSummary], seeds: range) -> None:
    """Adds the episodes of `seeds` to `result`. Raises EvaluationStoppedError after the first."""
    try:
        for seed in seeds:
            result.episodes.append(play(seed))
    except SpikeserveError as error:
        if not result.episodes:
            raise
        raise EvaluationStoppedError(error, result, len(seeds)) from error


def _make_environment(
    env: Any, arguments: Mapping[str, Any] | None, wrappers: Sequence[Callable[[Any], Any]]
) -> Any:
    if isinstance(env, str):
        import gymnasium  # an optional dependency that agents on robots do not need

        environment = gymnasium.make(env, **(arguments or {}))
    else:
        check(not arguments, "env_kwargs", "none with an environment", arguments)
        environment = env
    for wrap in wrappers:
        environment = wrap(environment)
    return environment


def _play(
    environment: Any, session: Session, distance: Distance, meter: EnergyMeter, seed: int
) -> EpisodeSummary:
    """Plays an episode, again from its start if its session was lost and reopened on the way."""
    for _ in range(_TRIES):
        before = session.reopened
        try:
            summary = play_episode(environment, session, seed, distance, meter)
        except SessionLostError:
            if not session.reopens:
                raise
        else:
            if session.reopened == before:
                return summary
    message = f"the session was lost in each of {_TRIES} tries of the episode with seed {seed}"
    raise SessionLostError("Act", grpc.StatusCode.NOT_FOUND, message)


def choose_policy(policies: list[Policy], env_id: str) -> Policy:
    """Returns the default version of the first policy for `env_id`. LookupError without one."""
    for policy in policies:
        if policy.environment == env_id and policy.is_default:
            return policy
    served = names_like(env_id, (f"{p.name}/{p.version} for {p.environment}" for p in policies))
    raise LookupError(
        f"env_id: expected the environment of a served policy ({served}), "
        f"received {env_id}; pass policy= to choose one"
    )


def play_episode(
    environment: Any,
    session: Session,
    seed: int,
    distance: Distance | None = None,
    meter: EnergyMeter | None = None,
) -> EpisodeSummary:
    """Plays one episode of a Gymnasium environment. Adds its energy to `meter`."""
    meter = meter or EnergyMeter()
    if distance is not None and not distance.is_none:
        return _play_far_away(environment, session, seed, distance, meter)
    observation, _ = environment.reset(seed=seed)
    reward, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        action = meter.add(session.act(observation, reward)).action
        observation, reward, terminated, truncated, _ = environment.step(action)
    return session.end_episode(float(reward), terminated, truncated, observation=observation)


def _play_far_away(
    environment: Any, session: Session, seed: int, distance: Distance, meter: EnergyMeter
) -> EpisodeSummary:
    arrivals = Arrivals(distance, as_action_space(environment.action_space), seed)
    observation, _ = environment.reset(seed=seed)
    reward, terminated, truncated, step, executed = 0.0, False, False, 0, None
    while not (terminated or truncated):
        decided = meter.add(session.act(observation, reward, executed_action=executed)).action
        executed = arrivals.executed(step, decided)
        observation, reward, terminated, truncated, _ = environment.step(executed)
        step += 1
    return session.end_episode(
        float(reward), terminated, truncated, observation=observation, executed_action=executed
    )
