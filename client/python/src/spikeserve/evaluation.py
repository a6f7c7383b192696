"""`evaluate` plays a Gymnasium environment with a served policy and reports returns and costs."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.client import Client
from spikeserve.session import Session
from spikeserve.spaces import as_action_space
from spikeserve.values import EpisodeSummary, Policy


@dataclass(frozen=True)
class Evaluation:
    """The result of `evaluate`. `episodes` are in the order of their seeds."""

    env_id: str
    policy: str
    version: int
    episodes: list[EpisodeSummary]

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
        """Returns the mean energy of a decision over all episodes, an estimate."""
        return sum(episode.energy_joules for episode in self.episodes) / self.decisions

    def __str__(self) -> str:
        return (
            f"{self.policy}/{self.version} plays {self.env_id}: return {self.mean_return:.1f} "
            f"± {self.std_return:.1f} over {len(self.episodes)} episodes, "
            f"{self.spikes_per_decision:.0f} spikes and "
            f"{self.energy_joules_per_decision * 1e9:.2f} nJ (estimated) a decision"
        )


def evaluate(
    env_id: str,
    policy: str | None = None,
    *,
    server: str | Client | None = None,
    episodes: int = 20,
    seed: int = 0,
) -> Evaluation:
    """Plays episodes of the Gymnasium environment `env_id` with the most probable actions.

    Episode i is reset with seed `seed` + i. The spaces of the environment are mapped to those of a
    policy (`spikeserve.flat_spaces`). `server` is an address, None for that of Client, or a client
    with its own options. Without `policy`, plays the served policy that was made for this
    environment.

    LookupError if no such policy is served. ValueError if `episodes` is less than 1, or if the
    action space of the policy differs from that of the environment.
    """
    import gymnasium  # an optional dependency that agents on robots do not need

    from spikeserve.flat_spaces import FlatEnvironment

    check(episodes >= 1, "episodes", "at least 1", episodes)
    connection = contextlib.nullcontext(server) if isinstance(server, Client) else Client(server)
    with (
        connection as client,
        contextlib.closing(FlatEnvironment(gymnasium.make(env_id))) as environment,
    ):
        name = policy or choose_policy(client.list_policies(), env_id).name
        with client.open_session(name) as session:
            assert session.opening is not None
            session.opening.check_action_space(as_action_space(environment.action_space))
            summaries = [
                play_episode(environment, session, seed + episode) for episode in range(episodes)
            ]
            return Evaluation(env_id, name, session.opening.version, summaries)


def choose_policy(policies: list[Policy], env_id: str) -> Policy:
    """Returns the default version of the first policy for `env_id`. LookupError without one."""
    for policy in policies:
        if policy.environment == env_id and policy.is_default:
            return policy
    served = ", ".join(f"{p.name}/{p.version} for {p.environment}" for p in policies)
    raise LookupError(
        f"env_id: expected the environment of a served policy ({served or 'none'}), "
        f"received {env_id}"
    )


def play_episode(environment: Any, session: Session, seed: int) -> EpisodeSummary:
    """Plays one episode of a Gymnasium environment."""
    observation, _ = environment.reset(seed=seed)
    reward, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        action = session.act(observation, reward).action
        observation, reward, terminated, truncated, _ = environment.step(action)
    return session.end_episode(float(reward), terminated, truncated, observation=observation)
