"""`evaluate`: how well, and at what cost, a served policy plays a Gymnasium environment."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.calls import DEFAULT_SERVER
from spikeserve.client import Client, Session
from spikeserve.spaces import as_action_space
from spikeserve.values import EpisodeSummary, Opening, Policy


@dataclass(frozen=True)
class Evaluation:
    """The episodes played, by seed."""

    env_id: str
    policy: str
    version: int
    episodes: list[EpisodeSummary]

    @property
    def returns(self) -> NDArray[np.float64]:
        """The return of each episode."""
        return np.array([episode.episode_return for episode in self.episodes])

    @property
    def mean_return(self) -> float:
        """The mean of the returns."""
        return float(np.mean(self.returns))

    @property
    def std_return(self) -> float:
        """The standard deviation of the returns."""
        return float(np.std(self.returns))

    @property
    def decisions(self) -> int:
        """Over all episodes."""
        return sum(episode.steps for episode in self.episodes)

    @property
    def spikes_per_decision(self) -> float:
        """Over all episodes."""
        return sum(episode.spikes for episode in self.episodes) / self.decisions

    @property
    def energy_joules_per_decision(self) -> float:
        """Over all episodes; an estimate."""
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
    server: str | Client = DEFAULT_SERVER,
    episodes: int = 20,
    seed: int = 0,
) -> Evaluation:
    """Plays `episodes` episodes of Gymnasium's `env_id`, the first from reset seed `seed`, the
    next from `seed` + 1 and so on, acting greedily.

    `server` is an address or, where there is more to say than that, a client. Without a `policy`,
    the served one that was made for this environment; LookupError if there is none, ValueError if
    its action space is not the environment's.
    """
    import gymnasium  # an extra: agents on robots have no need of it

    if episodes < 1:
        raise ValueError(f"episodes: expected at least 1, got {episodes}")
    connection = Client(server) if isinstance(server, str) else contextlib.nullcontext(server)
    with connection as client, contextlib.closing(gymnasium.make(env_id)) as environment:
        name = policy or choose_policy(client.list_policies(), env_id).name
        with client.open_session(name) as session:
            assert session.opening is not None
            _check_action_space(session.opening, environment)
            summaries = [
                play_episode(environment, session, seed + episode) for episode in range(episodes)
            ]
            return Evaluation(env_id, name, session.opening.version, summaries)


def choose_policy(policies: list[Policy], env_id: str) -> Policy:
    """The default version of the first policy made for `env_id`."""
    for policy in policies:
        if policy.environment == env_id and policy.is_default:
            return policy
    served = ", ".join(f"{p.name}/{p.version} for {p.environment}" for p in policies)
    raise LookupError(f"no policy for {env_id} is served; the server has {served or 'no policy'}")


def play_episode(environment: Any, session: Session, seed: int) -> EpisodeSummary:
    """One episode of a Gymnasium environment."""
    observation, _ = environment.reset(seed=seed)
    reward, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        action = session.act(observation, reward).action
        observation, reward, terminated, truncated, _ = environment.step(action)
    return session.end_episode(float(reward), terminated, truncated, observation=observation)


def _check_action_space(opening: Opening, environment: Any) -> None:
    space = as_action_space(environment.action_space)
    if space != opening.action_space:
        raise ValueError(
            f"action space: policy {opening.policy!r} has {opening.action_space}, "
            f"the environment has {space}"
        )
