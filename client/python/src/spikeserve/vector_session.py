"""`VectorSession`: the agents of a Gymnasium vector environment, one session a row."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.client import Client, Session
from spikeserve.values import SessionOptions
from spikeserve.vector_rows import VectorRows


class VectorSession(VectorRows):
    """Acts for every row of `envs`, a gymnasium.vector.VectorEnv, one ActBatch a step.

    Row i's session has the seed of `options` plus i. ValueError if the environment's spaces are
    not the policy's, or if it does not reset its rows itself. Not thread-safe.
    """

    def __init__(
        self, client: Client, policy: str, envs: Any, options: SessionOptions | None = None
    ) -> None:
        super().__init__(envs)
        self._client = client
        with contextlib.ExitStack() as opened:
            self._sessions: list[Session] = []
            for row_options in self._row_options(options):
                session = client.open_session(policy, row_options)
                self._sessions.append(opened.enter_context(session))
            self._check_fits(self._sessions[0].opening)
            self._opened = opened.pop_all()
        self._cursors = [session.cursor for session in self._sessions]

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
        infos: dict[str, Any] | None = None,
        timeout: float | None = None,
    ) -> NDArray[np.int64] | NDArray[np.float32]:
        """The actions for `envs.step`, from what it returned; after a reset, from observations.

        All rows move on or, if any fails, none does: after an error the same call may be made
        again. `infos` is for recordings of SAME_STEP environments: it has their final observations.
        """
        step = self._begin(observations, rewards, terminations, truncations, infos)
        for end in step.endings:
            self._newly_ended[end.row] = self._sessions[end.row].end_episode(
                end.reward, end.terminated, end.truncated, observation=end.observation
            )
        results = []
        if step.cursors:
            results = self._client.act_batch_messages(
                step.cursors, step.observations, step.rewards, timeout
            )
        return self._finish(step, results)

    def reset(self) -> None:
        """Call this where you call `envs.reset` in the middle of episodes: they end, truncated."""
        for session in self._sessions:
            if session.step > 0:
                session.end_episode(reward=0.0, truncated=True)
        self._newly_ended = {}
