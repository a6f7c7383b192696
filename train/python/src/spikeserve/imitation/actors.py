"""The actors: the expert with disturbances, the student, chance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spikeserve.engine import Engine, Session
from spikeserve.imitation.delays import Delayed
from spikeserve.imitation.episodes import Choice, FlatAction, Row
from spikeserve.imitation.experts import Expert


class RandomActor:
    """Draws every action uniformly."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def choose(self, rows: list[Row]) -> list[Choice]:
        """Returns a random action for each row."""
        return [Choice(row.environment.actions.sample(self._draws(row))) for row in rows]

    def end(self, row: Row) -> None:
        """Does nothing."""

    def _draws(self, row: Row) -> np.random.Generator:
        return np.random.default_rng([self._seed, row.episode.seed, row.episode.steps])


@dataclass(frozen=True)
class Bursts:
    """Bursts of random actions."""

    seed: int
    disturbed: float  # share of the episodes with bursts
    rate: float  # largest probability that a burst begins at a step
    longest: int  # steps
    held: float = 0.0  # share of the bursts that hold one random action


class _Disturbance:
    """The random actions of one episode."""

    def __init__(self, bursts: Bursts, row: Row) -> None:
        self._random = np.random.default_rng([bursts.seed, row.episode.seed])
        disturbed = self._random.random() < bursts.disturbed
        self._rate = bursts.rate * self._random.random() if disturbed else 0.0
        self._longest = bursts.longest
        self._held_share = bursts.held
        self._held: FlatAction | None = None
        self._left = 0

    def action(self, row: Row) -> FlatAction | None:
        """Returns the random action of this step; None outside of a burst."""
        if self._left == 0 and self._random.random() < self._rate:
            self._left = int(self._random.integers(1, self._longest, endpoint=True))
            held = self._held_share > 0 and self._random.random() < self._held_share
            self._held = row.environment.actions.sample(self._random) if held else None
        if self._left == 0:
            return None
        self._left -= 1
        if self._held is not None:
            return self._held
        return row.environment.actions.sample(self._random)


class _Disturbances:
    """The disturbance of each running episode; none without bursts."""

    def __init__(self, bursts: Bursts | None) -> None:
        self._bursts = bursts
        self._running: dict[int, _Disturbance] = {}

    def action(self, row: Row) -> FlatAction | None:
        """Returns the random action of this step; None outside of a burst."""
        if self._bursts is None:
            return None
        if row.index not in self._running:
            self._running[row.index] = _Disturbance(self._bursts, row)
        return self._running[row.index].action(row)

    def end(self, row: Row) -> None:
        """Forgets the disturbance of the episode."""
        self._running.pop(row.index, None)


class ExpertActor:
    """Plays the expert. Bursts of random actions replace its actions, but not its labels."""

    def __init__(self, expert: Expert, bursts: Bursts | None = None) -> None:
        self._expert = expert
        self._disturbances = _Disturbances(bursts)

    def choose(self, rows: list[Row]) -> list[Choice]:
        """Returns the expert's action as label, and the action to execute."""
        return [self._choose(row) for row in rows]

    def end(self, row: Row) -> None:
        """Forgets the disturbance of the episode."""
        self._disturbances.end(row)

    def _choose(self, row: Row) -> Choice:
        label = row.environment.actions.to_flat(self._expert(row.environment))
        action = self._disturbances.action(row)
        return Choice(label if action is None else action, label)


class StudentActor:
    """Plays a policy with the engine. An expert, if there is one, labels the states it reaches.

    Bursts of random actions replace the policy's actions, but not what the policy remembers of
    them.
    """

    def __init__(
        self, engine: Engine, expert: Expert | None = None, bursts: Bursts | None = None
    ) -> None:
        self._engine = engine
        self._expert = expert
        self._disturbances = _Disturbances(bursts)
        self._sessions: dict[int, Session] = {}

    def choose(self, rows: list[Row]) -> list[Choice]:
        """Returns the greedy actions of the policy."""
        sessions = [self._session(row) for row in rows]
        batch = self._engine.act_batch(
            sessions,
            np.stack([row.episode.observations[-1] for row in rows]),
            np.array([row.reward for row in rows]),
        )
        discrete = batch.actions.ndim == 1
        return [
            self._choice(row, int(action) if discrete else action, int(spikes))
            for row, action, spikes in zip(rows, batch.actions, batch.spikes, strict=True)
        ]

    def _choice(self, row: Row, action: FlatAction, spikes: int) -> Choice:
        disturbed = self._disturbances.action(row)
        return Choice(action if disturbed is None else disturbed, self._label(row), spikes)

    def end(self, row: Row) -> None:
        """Ends the episode of the row's session."""
        self._disturbances.end(row)
        self._sessions[row.index].end_episode(
            row.reward, row.episode.terminated, row.episode.truncated
        )

    def _session(self, row: Row) -> Session:
        if row.index not in self._sessions:
            self._sessions[row.index] = self._engine.session()
        return self._sessions[row.index]

    def _label(self, row: Row) -> FlatAction | None:
        if self._expert is None:
            return None
        return row.environment.actions.to_flat(self._expert(row.environment))


class DelayedStudentActor(StudentActor):
    """Plays a policy whose decisions are executed some steps after their observations.

    `delay_of` returns the steps of an episode by its seed. Until the first decision arrives, the
    neutral action is executed. The policy is told what was executed, bursts included.
    """

    def __init__(
        self,
        engine: Engine,
        delay_of: Callable[[int], int],
        expert: Expert | None = None,
        bursts: Bursts | None = None,
    ) -> None:
        super().__init__(engine, expert, bursts)
        self._delay_of = delay_of
        self._delayed = Delayed()

    def choose(self, rows: list[Row]) -> list[Choice]:
        """Returns the actions that arrive; the labels are the expert's in the present states."""
        return [self._arriving(row) for row in rows]

    def _arriving(self, row: Row) -> Choice:
        episode = row.episode
        last = episode.actions[-1] if episode.actions else None
        decision = self._session(row).act(
            episode.observations[-1], row.reward, executed_action=last
        )
        decided = Choice(decision.action, self._label(row), decision.stats.spikes)
        arrived = self._delayed.executed(row, decided, self._delay_of(episode.seed))
        disturbed = self._disturbances.action(row)
        return replace(decided, action=arrived if disturbed is None else disturbed)

    def end(self, row: Row) -> None:
        """Ends the episode of the row's session, and forgets what is under way."""
        self._disturbances.end(row)
        self._delayed.end(row)
        self._sessions[row.index].end_episode(
            row.reward,
            row.episode.terminated,
            row.episode.truncated,
            executed_action=row.episode.actions[-1],
        )
