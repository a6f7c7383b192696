"""`AsyncClient`: the asyncio client."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from spikeserve.async_connection import AsyncConnection
from spikeserve.async_session import AsyncSession
from spikeserve.async_stream import AsyncActStream
from spikeserve.batches import ExecutedActions, act_each, by_server
from spikeserve.calls import list_policies, named, open_session
from spikeserve.errors import SpikeserveError
from spikeserve.replicas import Route
from spikeserve.session_handle import SessionHandle
from spikeserve.values import Decision, Policy, SessionOptions


class AsyncClient(AsyncConnection):
    """Asyncio form of Client. Belongs to one event loop. Many sessions may call at once."""

    async def list_policies(self) -> list[Policy]:
        """Returns every policy version that is served, sorted by name, then by version."""
        return await self.perform(list_policies())

    async def open_session(
        self,
        policy: str,
        options: SessionOptions | None = None,
        *,
        observation: Sequence[str] = (),
        action: Sequence[str] = (),
        reopen: bool = False,
        route: Route | None = None,
    ) -> AsyncSession:
        """Asyncio form of Client.open_session."""
        open_again = functools.partial(
            open_session, policy, named(options, observation, action), route
        )
        return AsyncSession._of(self, await self.run(open_again()), open_again if reopen else None)

    async def act_batch(
        self,
        sessions: Sequence[SessionHandle[Any]],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
        *,
        executed_actions: ExecutedActions = None,
    ) -> list[Decision | SpikeserveError]:
        """Returns one decision or error for each session, with a single call.

        `executed_actions` has the executed action of each session's previous step, or None for a
        session that executed the answer. A session whose result is an error stays at its step. The
        others move to their next step. With several servers, there is one call for each of them
        that has some of the sessions, which stay together from then on.
        """
        cursors = [session.cursor for session in sessions]
        executed = [None] * len(cursors) if executed_actions is None else executed_actions
        results: dict[int, Decision | SpikeserveError] = {}
        for rows in by_server(cursors, self.replicas):
            batch = act_each(
                [cursors[row] for row in rows],
                [observations[row] for row in rows],
                [rewards[row] for row in rows],
                timeout,
                [executed[row] for row in rows],
            )
            answers = await self.perform(batch)
            results.update(zip(rows, answers, strict=True))
        return [results[row] for row in range(len(cursors))]

    def act_stream(self) -> AsyncActStream:
        """Asyncio form of Client.act_stream."""
        return AsyncActStream(self)
