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
            await AsyncSession.close(self)
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
        """Returns the decision at this step and moves to the next step.

        `observation` is in environment units. `reward` is for the previous action: step 0 ignores
        it, and every later step needs it (ValueError). `executed_action` is the action that was
        executed at the previous step, if it differs from the answered one, for example because a
        safety layer clipped it: the model remembers it, recordings hold it, and learning takes its
        score. ValueError, or InvalidArgumentError from the server, if it does not belong to the
        action space.

        `timeout` bounds the whole call with its retries, in seconds. After an error the session
        stays at its step, and the same call may be made again.

        SessionLostError if the server does not know the session any more. A session that was opened
        with `reopen=True` then continues with a new one, and `observation` is step 0 of its first
        episode: what the lost session remembered and learned is gone.
        """
        try:
            return await self._client.perform(
                self.cursor.act(observation, reward, timeout, executed_action)
            )
        except SessionLostError:
            if not self.reopens:
                raise
        await self._open_again()
        return await self._client.perform(self.cursor.act(observation, 0.0, timeout))

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
        """Sends the last reward, ends the episode and moves to step 0 of the next episode.

        `target_return` is for the next episode; None: the target return of the session.
        `observation` is the final observation, which only recordings use. `executed_action` is the
        executed last action, as for `act`. A repeated call is safe: the server counts the end once
        and returns the same summary. SessionLostError if the session was lost with the totals of
        its episode; with `reopen=True` the next `act` plays in a new session.
        """
        ending = self.cursor.end_episode(
            reward, terminated, truncated, target_return, observation, executed_action
        )
        try:
            return await self._client.perform(ending)
        except SessionLostError:
            if self.reopens:
                await self._open_again()
            raise

    async def state(self, *, include_head_delta: bool = False) -> SessionState:
        """Returns the state of the session on the server, on request with its learned head."""
        return await self._client.perform(self.cursor.state(include_head_delta))

    async def explain(self) -> Explanation:
        """Returns the spikes, attention, gates and logits of the last decision.

        Takes about a thousand times as long as a decision. FailedPreconditionError before the first
        decision of an episode.
        """
        return await self._client.perform(self.cursor.explain())

    async def open_again(self) -> None:
        """Opens a new session in the place of a lost one, with the options of the first.

        ValueError if the session was not opened with `reopen=True`.
        """
        await self._open_again()

    async def close(self) -> None:
        """Ends the session on the server. Does nothing if it was closed before, or lost."""
        if not self._closed:
            with contextlib.suppress(SessionLostError):
                await self._client.perform(self.cursor.close())
            self._closed = True
