"""`VectorSession`: the agents of a Gymnasium vector environment, one session a row.

Gymnasium 1.x resets an ended row by itself, in one of two ways:

* NEXT_STEP, its default: the step that ends an episode returns the final observation, and the next
  step ignores the row's action and returns the reset observation with reward 0. So the ended row
  is not acted on: it gets an action that nobody reads.
* SAME_STEP: the step that ends an episode returns the next episode's first observation already
  (the final one is in `infos["final_obs"]`), so the row is acted on at once.

Either way the ended episode gets its last reward, and no decision ever mixes two episodes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.client import Client, Session
from spikeserve.errors import SpikeserveError
from spikeserve.spaces import ActionSpace, as_action_space, stack_actions
from spikeserve.values import Decision, EpisodeSummary, SessionOptions

_NEXT_STEP = "NextStep"  # the values of gymnasium.vector.AutoresetMode
_SAME_STEP = "SameStep"


class VectorSession:
    """Acts for every row of `envs`, a gymnasium.vector.VectorEnv, one ActBatch a step.

    Row i's session has the seed of `options` plus i. ValueError if the environment's spaces are
    not the policy's, or if it does not reset its rows itself. Not thread-safe.

    `ended` holds the summary of each episode that the last `act` ended, by row; `decisions` the
    last decision of each row, None where it was not acted on.
    """

    def __init__(
        self, client: Client, policy: str, envs: Any, options: SessionOptions | None = None
    ) -> None:
        self._client = client
        self._num_envs = int(envs.num_envs)
        self._acts_on_ended_rows = _autoreset_mode(envs) == _SAME_STEP
        self._action_space = as_action_space(envs.single_action_space)
        self.decisions: list[Decision | None] = [None] * self._num_envs
        self.ended: dict[int, EpisodeSummary] = {}
        self._newly_ended: dict[int, EpisodeSummary] = {}
        options = options or SessionOptions()
        with contextlib.ExitStack() as opened:
            self._sessions: list[Session] = []
            for row in range(self._num_envs):
                session = client.open_session(policy, replace(options, seed=options.seed + row))
                self._sessions.append(opened.enter_context(session))
            _check_fits(self._sessions[0], envs, self._action_space)
            self._opened = opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._opened.__exit__(exception_type, exception, traceback)

    def close(self) -> None:
        """Ends the sessions on the server."""
        self._opened.close()

    @property
    def sessions(self) -> Sequence[Session]:
        """The rows' sessions."""
        return self._sessions

    def act(
        self,
        observations: ArrayLike,
        rewards: ArrayLike | None = None,
        terminations: ArrayLike | None = None,
        truncations: ArrayLike | None = None,
        timeout: float | None = None,
    ) -> NDArray[np.int64] | NDArray[np.float32]:
        """The actions for `envs.step`, from what it returned; after a reset, from observations.

        All rows move on or, if any fails, none does: after an error the same call may be made
        again.
        """
        observed = self._rows("observations", observations, np.float32)
        rewarded = self._rows("rewards", self._rewards(rewards), np.float64)
        terminated = self._rows("terminations", self._flags(terminations), np.bool_)
        truncated = self._rows("truncations", self._flags(truncations), np.bool_)
        self._end_episodes(rewarded, terminated, truncated)
        acting = np.arange(self._num_envs)
        if not self._acts_on_ended_rows:
            acting = acting[~(terminated | truncated)]
        self.decisions = self._decide(acting, observed, rewarded, timeout)
        self.ended, self._newly_ended = self._newly_ended, {}
        return stack_actions(
            [None if decision is None else decision.action for decision in self.decisions],
            self._action_space,
        )

    def reset(self) -> None:
        """Call this where you call `envs.reset` in the middle of episodes: they end, truncated."""
        for session in self._sessions:
            if session.step > 0:
                session.end_episode(reward=0.0, truncated=True)
        self._newly_ended = {}

    def _end_episodes(
        self,
        rewards: NDArray[np.float64],
        terminations: NDArray[np.bool_],
        truncations: NDArray[np.bool_],
    ) -> None:
        for row in np.flatnonzero(terminations | truncations):
            session = self._sessions[row]
            if session.step == 0:
                continue  # ended by a call that failed later on, and was made again
            self._newly_ended[int(row)] = session.end_episode(
                float(rewards[row]), bool(terminations[row]), bool(truncations[row])
            )

    def _decide(
        self,
        rows: NDArray[np.int64],
        observations: NDArray[np.float32],
        rewards: NDArray[np.float64],
        timeout: float | None,
    ) -> list[Decision | None]:
        decisions: list[Decision | None] = [None] * self._num_envs
        if not rows.size:
            return decisions
        cursors = [self._sessions[row].cursor for row in rows]
        results = self._client.act_batch_messages(
            cursors, list(observations[rows]), rewards[rows].tolist(), timeout
        )
        for cursor, result in zip(cursors, results, strict=True):
            if isinstance(result, SpikeserveError):
                raise result
            cursor.check(result)
        for row, cursor, result in zip(rows, cursors, results, strict=True):
            decisions[row] = cursor.accept(result)
        return decisions

    def _rewards(self, rewards: ArrayLike | None) -> ArrayLike:
        if rewards is not None:
            return rewards
        if any(session.step > 0 for session in self._sessions):
            raise ValueError("rewards: expected one a row within an episode, got None")
        return np.zeros(self._num_envs)

    def _flags(self, flags: ArrayLike | None) -> ArrayLike:
        return np.zeros(self._num_envs, np.bool_) if flags is None else flags

    def _rows(self, field: str, values: ArrayLike, dtype: Any) -> NDArray[Any]:
        """`values` as an array of one row an environment."""
        array = np.asarray(values, dtype)
        dimensions = 2 if field == "observations" else 1
        if array.ndim != dimensions or len(array) != self._num_envs:
            expected = f"({self._num_envs},{' n' if dimensions == 2 else ''})"
            raise ValueError(f"{field}: expected shape {expected}, got {array.shape}")
        return array


def _autoreset_mode(envs: Any) -> str:
    mode = envs.metadata.get("autoreset_mode", _NEXT_STEP)
    name = str(getattr(mode, "value", mode))
    if name not in (_NEXT_STEP, _SAME_STEP):
        raise ValueError(f"autoreset_mode: expected {_NEXT_STEP} or {_SAME_STEP}, got {name}")
    return name


def _check_fits(session: Session, envs: Any, action_space: ActionSpace) -> None:
    assert session.opening is not None
    policy = session.opening
    shape = tuple(envs.single_observation_space.shape)
    if shape != (policy.observation_size,):
        raise ValueError(
            f"observation space: policy {policy.policy!r} takes shape "
            f"({policy.observation_size},), the environment has {shape}"
        )
    if action_space != policy.action_space:
        raise ValueError(
            f"action space: policy {policy.policy!r} has {policy.action_space}, "
            f"the environment has {action_space}"
        )
