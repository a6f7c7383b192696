"""`AsyncVectorSession`: the agents of a Gymnasium vector environment, with asyncio."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from spikeserve.async_client import AsyncClient
from spikeserve.async_session import AsyncSession
from spikeserve.calls import Call
from spikeserve.errors import SessionLostError
from spikeserve.values import EpisodeSummary, SessionOptions
from spikeserve.vector_rows import Actions, VectorRows

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class AsyncVectorSession(VectorRows[AsyncSession]):
    """Asyncio form of VectorSession. `open` makes one. One call at a time."""

    def __init__(self, client: AsyncClient, envs: Any) -> None:
        super().__init__(client, envs)
        self._opened = contextlib.AsyncExitStack()

    @classmethod
    async def open(
        cls,
        client: AsyncClient,
        policy: str,
        envs: Any,
        options: SessionOptions | None = None,
        *,
        reopen: bool = False,
    ) -> Self:
        """Opens a session for every row. Raises the same errors as VectorSession."""
        rows = cls(client, envs)
        async with contextlib.AsyncExitStack() as opened:
            for row_options in rows._row_options(options):
                session = await client.open_session(
                    policy, row_options, reopen=reopen, route=rows._route
                )
                rows._sessions.append(await opened.enter_async_context(session))
            rows._check_fits()
            rows._opened = opened.pop_all()
        return rows

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exception: Any) -> None:
        await self._opened.__aexit__(*exception)

    async def close(self) -> None:
        """Asyncio form of VectorSession.close."""
        await self._opened.aclose()

    async def act(
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
        await self._end_all(step.endings)
        while True:
            try:
                decisions = await self._client.perform(step.batch(timeout)) if step.cursors else []
                return self._finish(step, decisions)
            except SessionLostError as error:
                lost = self._lost_rows(error)
            for session in lost:
                await session._open_again()

    async def reset(self) -> None:
        """Ends the running episodes as truncated. Call it where you call `envs.reset`."""
        for ending in self._truncations():
            await self._client.perform(ending)
        self._newly_ended = {}

    async def _end_all(self, endings: Mapping[int, Call[EpisodeSummary]]) -> None:
        """Ends the episodes concurrently."""
        # Every ending is awaited, so that `_newly_ended` has all that succeed if one fails.
        ended = (self._end(row, ending) for row, ending in endings.items())
        for error in await asyncio.gather(*ended, return_exceptions=True):
            if error is not None:
                raise error
