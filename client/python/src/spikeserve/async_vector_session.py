"""`AsyncVectorSession`: VectorSession, awaited."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.async_client import AsyncClient, AsyncSession
from spikeserve.values import SessionOptions
from spikeserve.vector_rows import Ending, VectorRows


class AsyncVectorSession(VectorRows):
    """VectorSession for asyncio. Made by `open`; one call at a time."""

    def __init__(self, client: AsyncClient, envs: Any) -> None:
        super().__init__(envs)
        self._client = client
        self._sessions: list[AsyncSession] = []
        self._opened = contextlib.AsyncExitStack()

    @classmethod
    async def open(
        cls, client: AsyncClient, policy: str, envs: Any, options: SessionOptions | None = None
    ) -> Self:
        """The sessions of every row; errors are VectorSession's."""
        rows = cls(client, envs)
        async with contextlib.AsyncExitStack() as opened:
            for row_options in rows._row_options(options):
                session = await client.open_session(policy, row_options)
                rows._sessions.append(await opened.enter_async_context(session))
            rows._check_fits(rows._sessions[0].opening)
            rows._opened = opened.pop_all()
        rows._cursors = [session.cursor for session in rows._sessions]
        return rows

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self._opened.__aexit__(exception_type, exception, traceback)

    async def close(self) -> None:
        """VectorSession.close."""
        await self._opened.aclose()

    @property
    def sessions(self) -> Sequence[AsyncSession]:
        """The rows' sessions."""
        return self._sessions

    async def act(
        self,
        observations: ArrayLike,
        rewards: ArrayLike | None = None,
        terminations: ArrayLike | None = None,
        truncations: ArrayLike | None = None,
        infos: dict[str, Any] | None = None,
        timeout: float | None = None,
    ) -> NDArray[np.int64] | NDArray[np.float32]:
        """VectorSession.act; the rows that end do so at the same time."""
        step = self._begin(observations, rewards, terminations, truncations, infos)
        await self._end(step.endings)
        results = []
        if step.cursors:
            results = await self._client.act_batch_messages(
                step.cursors, step.observations, step.rewards, timeout
            )
        return self._finish(step, results)

    async def reset(self) -> None:
        """VectorSession.reset."""
        for session in self._sessions:
            if session.step > 0:
                await session.end_episode(reward=0.0, truncated=True)
        self._newly_ended = {}

    async def _end(self, endings: Sequence[Ending]) -> None:
        """Those that succeed have ended, also where another fails."""
        summaries = await asyncio.gather(
            *(
                self._sessions[end.row].end_episode(
                    end.reward, end.terminated, end.truncated, observation=end.observation
                )
                for end in endings
            ),
            return_exceptions=True,
        )
        errors = []
        for end, summary in zip(endings, summaries, strict=True):
            if isinstance(summary, BaseException):
                errors.append(summary)
            else:
                self._newly_ended[end.row] = summary
        if errors:
            raise errors[0]
