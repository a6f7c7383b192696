"""`AsyncSession`: the session of one agent, with asyncio."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from spikeserve.async_connection import AsyncConnection
from spikeserve.errors import SessionLostError, SpikeserveError
from spikeserve.explanation import Explanation
from spikeserve.session_handle import SessionHandle
from spikeserve.values import Decision, EpisodeSummary, ExecutedLike, SessionState

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class AsyncSession(SessionHandle[AsyncConnection]):
    """Asyncio form of Session. One call at a time. A cancelled call may be made again."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, exception_type: type[BaseException] | None, *_: object) -> None:
        try:
            await self.close()
        except SpikeserveError:
            if exception_type is None:  # otherwise the first exception matters more
                raise

    async def act(
        self,
        observation: ArrayLike,
        reward: float | None = None,
        timeout: float | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> Decision:
        """Asyncio form of Session.act."""
        try:
            return await self._client.run(
                self.cursor.act(observation, reward, timeout, executed_action)
            )
        except SessionLostError:
            if not self.reopens:
                raise
        await self.open_again()
        return await self._client.run(self.cursor.act(observation, 0.0, timeout))

    async def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> EpisodeSummary:
        """Asyncio form of Session.end_episode."""
        ending = self.cursor.end_episode(
            reward, terminated, truncated, target_return, observation, executed_action
        )
        try:
            return await self._client.run(ending)
        except SessionLostError:
            if self.reopens:
                await self.open_again()
            raise

    async def state(self, *, include_head_delta: bool = False) -> SessionState:
        """Asyncio form of Session.state."""
        return await self._client.run(self.cursor.state(include_head_delta))

    async def explain(self) -> Explanation:
        """Asyncio form of Session.explain."""
        return await self._client.run(self.cursor.explain())

    async def open_again(self) -> None:
        """Asyncio form of Session.open_again."""
        self._move_to(await self._client.run(self._reopening()))

    async def close(self) -> None:
        """Asyncio form of Session.close."""
        if not self._closed:
            with contextlib.suppress(SessionLostError):
                await self._client.run(self.cursor.close())
            self._closed = True
