"""`AsyncClient`: the asyncio client."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from numpy.typing import ArrayLike

from spikeserve.async_connection import AsyncConnection
from spikeserve.async_session import AsyncSession
from spikeserve.async_stream import AsyncActStream
from spikeserve.batches import ExecutedActions, act_each, by_server
from spikeserve.calls import list_policies, named, open_session
from spikeserve.errors import SpikeserveError
from spikeserve.replicas import Route
from spikeserve.values import Decision, Policy, SessionOptions


class AsyncClient(AsyncConnection):
    """Asyncio form of Client. Belongs to one event loop. Many sessions may call at once."""

    async def list_policies(self) -> list[Policy]:
        """Asyncio form of Client.list_policies."""
        return await self.run(list_policies())

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
        sessions: Sequence[AsyncSession],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
        *,
        executed_actions: ExecutedActions = None,
    ) -> list[Decision | SpikeserveError]:
        """Asyncio form of Client.act_batch."""
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
            answers = await self.run(batch)
            results.update(zip(rows, answers, strict=True))
        return [results[row] for row in range(len(cursors))]

    def act_stream(self) -> AsyncActStream:
        """Asyncio form of Client.act_stream."""
        return AsyncActStream(self)
