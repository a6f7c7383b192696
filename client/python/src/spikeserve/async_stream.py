"""`AsyncActStream`: ActStream, awaited."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import grpc
from numpy.typing import ArrayLike

from spikeserve.calls import OpenRequests, stream_ended
from spikeserve.errors import SpikeserveError, error_of_call
from spikeserve.values import Decision

if TYPE_CHECKING:
    from spikeserve.async_client import AsyncSession


class AsyncActStream:
    """ActStream for asyncio. One task at a time sends, and one receives.

    A `receive` that is cancelled, by asyncio.timeout for example, ends the stream.
    """

    def __init__(self, call: Any) -> None:
        self._call = call
        self._open: OpenRequests[AsyncSession] = OpenRequests()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    async def send(
        self, session: AsyncSession, observation: ArrayLike, reward: float = 0.0
    ) -> None:
        """ActStream.send."""
        request = self._open.add(session, observation, reward)
        try:
            await self._call.write(request)
        except grpc.RpcError as error:
            raise error_of_call("ActStream", error) from error

    async def receive(self) -> tuple[AsyncSession, Decision | SpikeserveError]:
        """ActStream.receive."""
        try:
            reply = await self._call.read()
        except grpc.RpcError as error:
            raise error_of_call("ActStream", error) from error
        if reply is grpc.aio.EOF:
            raise stream_ended()
        return self._open.accept(reply)

    async def act(
        self, session: AsyncSession, observation: ArrayLike, reward: float = 0.0
    ) -> Decision:
        """ActStream.act."""
        self._open.check_empty()
        await self.send(session, observation, reward)
        _, result = await self.receive()
        if isinstance(result, SpikeserveError):
            raise result
        return result

    def close(self) -> None:
        """ActStream.close."""
        self._call.cancel()
