"""`AsyncClient`: the asyncio client."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from spikeserve.async_session import AsyncSession
from spikeserve.async_stream import AsyncActStream
from spikeserve.calls import ExecutedActions, act_each, list_policies, open_session
from spikeserve.connection import AsyncConnection
from spikeserve.errors import SpikeserveError
from spikeserve.values import Decision, Policy, SessionOptions


class AsyncClient(AsyncConnection):
    """Asyncio form of Client. Belongs to one event loop. Many sessions may call at once."""

    async def list_policies(self) -> list[Policy]:
        """Asyncio form of Client.list_policies."""
        return await self.run(list_policies())

    async def open_session(
        self, policy: str, options: SessionOptions | None = None, *, reopen: bool = False
    ) -> AsyncSession:
        """Asyncio form of Client.open_session."""
        opening = open_session(policy, options)
        session_id, opened = await self.run(opening)
        return AsyncSession(self, session_id, opening=opened, reopening=opening if reopen else None)

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
        return await self.run(act_each(cursors, observations, rewards, timeout, executed_actions))

    def act_stream(self) -> AsyncActStream:
        """Asyncio form of Client.act_stream."""
        return AsyncActStream(self._open_stream, self._options.retry, self._patience)
