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
from spikeserve.calls import amend_episode, list_policies, named, open_session
from spikeserve.check import check
from spikeserve.errors import SpikeserveError
from spikeserve.replicas import Route
from spikeserve.session_handle import SessionHandle
from spikeserve.values import AmendedEpisode, Decision, Policy, SessionOptions


class AsyncClient(AsyncConnection):
    """Asyncio form of Client. Belongs to one event loop. Many sessions may call at once."""

    async def list_policies(self) -> list[Policy]:
        """Returns every policy version that is served, sorted by name, then by version."""
        return await self.perform(list_policies())

    async def amend_episode(
        self,
        session: str,
        episode: int,
        amendment_id: str,
        *,
        rewards: Sequence[float] = (),
        reward: float | None = None,
        success: bool | None = None,
        label: str = "",
        author: str = "",
    ) -> AmendedEpisode:
        """Gives an episode that has ended the verdict that came late.

        `session` is the id of an open session, or the name of a recording of the server. `rewards`
        take the place of those received, one a step; `reward` is added to the last one. `success`
        and `label` are for recordings. The same verdict may be sent again with its `amendment_id`.
        NotFoundError if neither the session nor the recording has the episode,
        FailedPreconditionError if it has waited longer than `Learning.verdict_seconds`.
        """
        return await self.perform(
            amend_episode(
                session,
                episode,
                amendment_id,
                rewards=rewards,
                reward=reward,
                success=success,
                label=label,
                author=author,
            )
        )

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
        that has some of the sessions, which stay together from then on. If one of these calls
        fails, its error is the result of these sessions, unless no session has a decision.
        """
        cursors = [session.cursor for session in sessions]
        executed = [None] * len(cursors) if executed_actions is None else executed_actions
        given = {"observations": observations, "rewards": rewards, "executed_actions": executed}
        for name, values in given.items():
            check(len(values) == len(cursors), name, f"{len(cursors)} of them", len(values))
        groups = by_server(cursors, self.replicas)
        batches = [
            act_each(
                [cursors[row] for row in rows],
                [observations[row] for row in rows],
                [rewards[row] for row in rows],
                timeout,
                [executed[row] for row in rows],
            )
            for rows in groups
        ]
        results: dict[int, Decision | SpikeserveError] = {}
        failure: SpikeserveError | None = None
        for rows, batch in zip(groups, batches, strict=True):
            try:
                answers = await self.perform(batch)
            except SpikeserveError as error:
                answers = [error] * len(rows)
                failure = failure or error
            results.update(zip(rows, answers, strict=True))
        if failure is not None and not any(isinstance(r, Decision) for r in results.values()):
            raise failure
        return [results[row] for row in range(len(cursors))]

    def act_stream(self) -> AsyncActStream:
        """Asyncio form of Client.act_stream."""
        return AsyncActStream(self)
