"""`VectorSession`: the agents of a Gymnasium vector environment, blocking."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from spikeserve.client import Client
from spikeserve.errors import SessionLostError
from spikeserve.session import Session
from spikeserve.values import SessionOptions
from spikeserve.vector_rows import Actions, VectorRows

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class VectorSession(VectorRows[Session]):
    """Acts for every row of `envs`, a gymnasium.vector.VectorEnv, with one ActBatch a step.

    Each row has its own session. The seed of row i is the seed of `options` plus i. ValueError if
    the spaces of the environment differ from those of the policy, or if the environment does not
    reset its rows by itself. With `reopen`, rows whose session was lost continue with a new one, as
    Session.act describes; `ended` then misses the episodes that were lost. Not thread-safe.
    """

    def __init__(
        self,
        client: Client,
        policy: str,
        envs: Any,
        options: SessionOptions | None = None,
        *,
        reopen: bool = False,
    ) -> None:
        super().__init__(envs)
        self._client = client
        with contextlib.ExitStack() as opened:
            for row_options in self._row_options(options):
                session = client.open_session(policy, row_options, reopen=reopen, route=self._route)
                self._sessions.append(opened.enter_context(session))
            self._check_fits()
            self._opened = opened.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._opened.__exit__(*exception)

    def close(self) -> None:
        """Ends the sessions on the server."""
        self._opened.close()

    def act(
        self,
        observations: ArrayLike,
        rewards: ArrayLike | None = None,
        terminations: ArrayLike | None = None,
        truncations: ArrayLike | None = None,
        infos: dict[str, Any] | None = None,
        timeout: float | None = None,
        *,
        executed_actions: ArrayLike | None = None,
    ) -> Actions:
        """Returns the actions for `envs.step`.

        The arguments are what `envs.step` returned. After `envs.reset`, the observations suffice.
        `infos` holds the final observations of SAME_STEP environments, which only recordings use.
        `executed_actions` are the actions that `envs.step` received, if they differ from those that
        the last `act` returned.
        If any row fails, no row moves to its next step, and the same call may be made again.
        """
        step = self._begin(
            observations, rewards, terminations, truncations, infos, executed_actions
        )
        for row, ending in step.endings.items():
            try:
                self._newly_ended[row] = self._client.run(ending)
            except SessionLostError as error:
                for session in self._lost_rows(error):
                    session.open_again()
        while True:
            try:
                decisions = self._client.run(step.batch(timeout)) if step.cursors else []
                return self._finish(step, decisions)
            except SessionLostError as error:
                lost = self._lost_rows(error)
            for session in lost:
                session.open_again()

    def reset(self) -> None:
        """Ends the running episodes as truncated. Call it where you call `envs.reset`."""
        for ending in self._truncations():
            self._client.run(ending)
        self._newly_ended = {}
