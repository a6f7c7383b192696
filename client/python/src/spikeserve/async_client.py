"""The asyncio client: `AsyncClient` and `AsyncSession`, like those of spikeserve.client.

One AsyncClient belongs to one event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import grpc
import grpc.aio
from numpy.typing import ArrayLike

from spikeserve.async_stream import AsyncActStream
from spikeserve.calls import (
    CHANNEL_OPTIONS,
    DEFAULT_SERVER,
    Attempts,
    ClientOptions,
    SessionCursor,
    batch_request,
    batch_results,
)
from spikeserve.errors import NotFoundError, SpikeserveError
from spikeserve.values import (
    Decision,
    EpisodeSummary,
    Opening,
    Policy,
    SessionOptions,
    SessionState,
)
from spikeserve.wire import ACT_STREAM, METHODS, Message


class AsyncClient:
    """Client, awaited. Many sessions may have a call under way at once."""

    def __init__(
        self,
        server: str = DEFAULT_SERVER,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        self._options = options or ClientOptions()
        if credentials is None:
            self._channel = grpc.aio.insecure_channel(server, CHANNEL_OPTIONS)
        else:
            self._channel = grpc.aio.secure_channel(server, credentials, CHANNEL_OPTIONS)
        self._calls = {name: method.bind(self._channel) for name, method in METHODS.items()}
        self._open_stream = ACT_STREAM.bind(self._channel)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Client.close."""
        await self._channel.close()

    async def list_policies(self) -> list[Policy]:
        """Client.list_policies."""
        response = await self.call("ListPolicies", METHODS["ListPolicies"].request())
        return [Policy.from_wire(policy) for policy in response.policies]

    async def open_session(
        self, policy: str, options: SessionOptions | None = None
    ) -> AsyncSession:
        """Client.open_session."""
        response = await self.call("OpenSession", (options or SessionOptions()).to_wire(policy))
        return AsyncSession(self, response.session_id, opening=Opening.from_wire(response))

    async def act_batch(
        self,
        sessions: Sequence[AsyncSession],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
    ) -> list[Decision | SpikeserveError]:
        """Client.act_batch."""
        cursors = [session.cursor for session in sessions]
        results = await self.act_batch_messages(cursors, observations, rewards, timeout)
        return [
            result if isinstance(result, SpikeserveError) else cursor.accept(result)
            for cursor, result in zip(cursors, results, strict=True)
        ]

    async def act_batch_messages(
        self,
        cursors: Sequence[SessionCursor],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
    ) -> list[Any]:
        """Client.act_batch_messages."""
        request = batch_request(cursors, observations, rewards)
        return batch_results(await self.call("ActBatch", request, timeout), len(cursors))

    def act_stream(self) -> AsyncActStream:
        """Client.act_stream."""
        return AsyncActStream(self._open_stream())

    async def call(
        self,
        name: str,
        request: Message,
        timeout: float | None = None,
        repeated: type[SpikeserveError] | None = None,
    ) -> Message:
        """Client.call."""
        attempts = Attempts(name, self._options.retry, repeated)
        deadline = self._options.timeout if timeout is None else timeout
        while True:
            try:
                return await self._calls[name](
                    request, timeout=deadline, metadata=self._options.metadata
                )
            except grpc.RpcError as error:
                pause = attempts.pause_after(error)
            if pause is None:
                return None
            await asyncio.sleep(pause)


class AsyncSession:
    """Session, awaited. One call at a time; a cancelled one may be made again."""

    def __init__(
        self, client: AsyncClient, session_id: str, step: int = 0, opening: Opening | None = None
    ) -> None:
        self._client = client
        self.cursor = SessionCursor(session_id, step)
        self.opening = opening

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            await self.close()
        except SpikeserveError:
            if exception is None:  # otherwise what went wrong first matters more
                raise

    @property
    def session_id(self) -> str:
        """The server's name of the session."""
        return self.cursor.session_id

    @property
    def step(self) -> int:
        """The step of the next request."""
        return self.cursor.step

    async def act(
        self, observation: ArrayLike, reward: float = 0.0, timeout: float | None = None
    ) -> Decision:
        """Session.act."""
        request = self.cursor.act_request(observation, reward)
        return self.cursor.accept(await self._client.call("Act", request, timeout))

    async def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
    ) -> EpisodeSummary:
        """Session.end_episode."""
        request = self.cursor.end_request(reward, terminated, truncated, target_return, observation)
        return self.cursor.end(await self._client.call("EndEpisode", request))

    async def state(self) -> SessionState:
        """Session.state."""
        request = METHODS["GetSession"].request(session_id=self.session_id)
        return SessionState.from_wire(await self._client.call("GetSession", request))

    async def close(self) -> None:
        """Session.close."""
        request = METHODS["CloseSession"].request(session_id=self.session_id)
        await self._client.call("CloseSession", request, repeated=NotFoundError)
