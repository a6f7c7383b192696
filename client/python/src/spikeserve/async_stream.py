"""`AsyncActStream`: the decisions of any number of sessions on one stream, with asyncio."""

from __future__ import annotations

from typing import Any, Self

import grpc
from numpy.typing import ArrayLike

from spikeserve.async_session import AsyncSession
from spikeserve.errors import SpikeserveError, error_of_call
from spikeserve.open_requests import OpenRequests, stream_ended
from spikeserve.values import ActionLike, Decision


class AsyncActStream:
    """Asyncio form of ActStream. One task at a time may send, and one may receive.

    A `receive` that is cancelled, for example by asyncio.timeout, ends the stream.
    """

    def __init__(self, call: Any) -> None:
        self._call = call
        self._open: OpenRequests[AsyncSession] = OpenRequests()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    async def send(
        self,
        session: AsyncSession,
        observation: ArrayLike,
        reward: float = 0.0,
        *,
        executed_action: ActionLike | None = None,
    ) -> None:
        """Asyncio form of ActStream.send."""
        request = self._open.add(session, observation, reward, executed_action)
        try:
            await self._call.write(request)
        except grpc.RpcError as error:
            raise error_of_call("ActStream", error) from error

    async def receive(self) -> tuple[AsyncSession, Decision | SpikeserveError]:
        """Asyncio form of ActStream.receive."""
        try:
            reply = await self._call.read()
        except grpc.RpcError as error:
            raise error_of_call("ActStream", error) from error
        if reply is grpc.aio.EOF:
            raise stream_ended()
        return self._open.accept(reply)

    async def act(
        self,
        session: AsyncSession,
        observation: ArrayLike,
        reward: float = 0.0,
        *,
        executed_action: ActionLike | None = None,
    ) -> Decision:
        """Asyncio form of ActStream.act."""
        self._open.check_empty()
        await self.send(session, observation, reward, executed_action=executed_action)
        _, result = await self.receive()
        if isinstance(result, SpikeserveError):
            raise result
        return result

    def close(self) -> None:
        """Ends the stream. Drops answers that were not received."""
        self._call.cancel()
