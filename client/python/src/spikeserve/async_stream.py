"""`AsyncActStream`: the decisions of any number of sessions on one stream, with asyncio."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import grpc
from numpy.typing import ArrayLike

from spikeserve.async_connection import AsyncConnection, Watch, is_cancelled
from spikeserve.async_session import AsyncSession
from spikeserve.errors import SpikeserveError, code_of_end, make_error
from spikeserve.open_requests import stream_ended, stream_silent
from spikeserve.stream_core import StreamCore
from spikeserve.values import Decision, ExecutedLike
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

# What grpc.aio reports with INTERNAL if a stream is opened while the server cannot be reached.
_CORE_ERROR = "Internal error from Core"


class AsyncActStream(StreamCore[AsyncSession]):
    """Asyncio form of ActStream. One task at a time may send, and one may receive.

    A `receive` that is cancelled, for example by asyncio.timeout, ends the stream. Its requests
    without an answer are sent again on another stream by the next `send` or `receive`.
    """

    def __init__(self, client: AsyncConnection) -> None:
        super().__init__(client)
        self._writing = asyncio.Lock()  # gRPC allows one write at a time
        self._resending: asyncio.Task[None] | None = None
        self._call = self._opener.open()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    send = StreamCore[AsyncSession]._send

    async def receive(self) -> tuple[AsyncSession, Decision | SpikeserveError]:
        """Asyncio form of ActStream.receive."""
        return await self._receive()

    async def act(
        self,
        session: AsyncSession,
        observation: ArrayLike,
        reward: float | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> Decision:
        """Asyncio form of ActStream.act."""
        return await self._act(session, observation, reward, executed_action)

    def close(self) -> None:
        """Ends the stream. Drops answers that were not received."""
        self._closed = True
        self._call.cancel()
        if self._resending is not None:
            self._resending.cancel()

    async def _write(self, request: Message) -> None:
        # A broken call is repaired by `receive`, which sends the open requests again.
        with contextlib.suppress(grpc.RpcError, asyncio.InvalidStateError):
            async with self._writing:
                await self._call.write(request)

    async def _next_reply(self, deadline: float | None) -> Message | SpikeserveError:
        if self._call.cancelled():  # with a `receive` that was cancelled
            return stream_ended()
        watch = Watch(self._open.doubt)
        try:
            reply = await self._read_in_time()
        except asyncio.CancelledError:
            if self._opener.is_renewed and not is_cancelled():
                return stream_ended()
            raise
        except grpc.RpcError:
            # The error of a read may only say that the call has ended; its status has the reason.
            code, details = await self._call.code(), await self._call.details()
            # A proxy may cancel the streams of a server that has ended.
            if details == _CORE_ERROR or code == grpc.StatusCode.CANCELLED:
                code = grpc.StatusCode.UNAVAILABLE
            details = details or ""
            return make_error("ActStream", code_of_end(code, details), details)
        finally:
            watch.stop()
        return stream_ended() if reply is grpc.aio.EOF else reply

    async def _read_in_time(self) -> Any:
        """Reads the next reply. Returns an error if another server should be asked in its place."""
        if not self._opener.has_others:
            return await self._call.read()
        reading = asyncio.ensure_future(self._call.read())
        try:
            while not reading.done():
                await asyncio.wait([reading], timeout=self._open.seconds_until_silent())
                if not reading.done() and self._open.is_silent():
                    return stream_silent()
            return reading.result()
        finally:
            reading.cancel()

    async def _send_due(self) -> None:
        while (seconds := self._open.seconds_until_due()) is not None:
            await asyncio.sleep(seconds)
            for request in self._open.take_due():
                await self._write(request)

    async def _break(self, error: SpikeserveError) -> None:
        pause = self._open.pause_after_break(error)
        if pause is not None:
            await asyncio.sleep(pause)
            await self._start()

    def _is_over(self) -> bool:
        return bool(self._call.done())

    def _resend_later(self) -> None:
        # The requests of other sessions are answered while this one waits.
        if self._resending is None or self._resending.done():
            self._resending = asyncio.create_task(self._send_due())

    def _open_call(self) -> None:
        self._call.cancel()
        self._call = self._opener.open()
