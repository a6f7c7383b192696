"""`VectorSession`: the agents of a Gymnasium vector environment, blocking."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from spikeserve.async_vector_session import AsyncVectorSession
from spikeserve.calls import Call
from spikeserve.client import Client
from spikeserve.coroutines import blocking
from spikeserve.session import Session
from spikeserve.values import EpisodeSummary, SessionOptions
from spikeserve.vector_rows import VectorRows

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
        super().__init__(client, envs)
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

    act = blocking(AsyncVectorSession.act)
    reset = blocking(AsyncVectorSession.reset)

    async def _end_all(self, endings: Mapping[int, Call[EpisodeSummary]]) -> None:
        for row, ending in endings.items():
            await self._end(row, ending)
