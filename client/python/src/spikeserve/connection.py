"""The connection of a client to its server: `Connection` blocks, `AsyncConnection` awaits.

Only these two classes send unary calls, wait for responses and repeat failed attempts.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self, TypeVar

import grpc
import grpc.aio

from spikeserve.calls import Call
from spikeserve.check import check
from spikeserve.diagnosis import diagnose
from spikeserve.errors import SpikeserveError, is_retryable, is_retryable_code, make_error
from spikeserve.retry import Attempts, Patience, RetryOptions
from spikeserve.wire import ACT_STREAM, METHODS, Message, Method

T = TypeVar("T")


def default_server() -> str:
    """Returns the address in the environment variable SPIKESERVE_SERVER, or 127.0.0.1:50051."""
    return os.environ.get("SPIKESERVE_SERVER") or "127.0.0.1:50051"


# The C++ client sets the same options. Each client has its own connection, and reconnects to a
# restarted server within one second. The default of gRPC is two minutes.
CHANNEL_OPTIONS = [
    ("grpc.use_local_subchannel_pool", 1),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1000),
]


@dataclass(frozen=True)
class ClientOptions:
    """Settings of a client. ValueError if a field is out of its range."""

    timeout: float = 5.0  # seconds for each attempt of a call
    connect_timeout: float = 3.0  # seconds of attempts to reach a server for the first time
    retry: RetryOptions = field(default_factory=RetryOptions)
    # Sent with every call. The default is the environment variable SPIKESERVE_TOKEN.
    token: str = field(default_factory=lambda: os.environ.get("SPIKESERVE_TOKEN", ""), repr=False)

    def __post_init__(self) -> None:
        check(self.timeout > 0, "timeout", "more than 0", self.timeout)
        least = self.connect_timeout
        check(least >= 0, "connect_timeout", "at least 0", least)

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """Returns the gRPC metadata of every call."""
        return (("authorization", f"Bearer {self.token}"),) if self.token else ()


class _Channel:
    """A gRPC channel and the methods of a service on it, blocking or not."""

    _transport: ClassVar[Any]  # grpc or grpc.aio, whose functions have the same names
    _table: ClassVar[dict[str, Method]] = METHODS  # the methods of the service by name

    def __init__(
        self,
        server: str | None = None,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        self._options = options or ClientOptions()
        self.server = default_server() if server is None else server
        if credentials is None:
            self._channel = self._transport.insecure_channel(self.server, CHANNEL_OPTIONS)
        else:
            self._channel = self._transport.secure_channel(
                self.server, credentials, CHANNEL_OPTIONS
            )
        self._encrypts = credentials is not None
        self._reached = False  # whether the server has answered a call
        self._methods = {name: method.bind(self._channel) for name, method in self._table.items()}

    def _explain(self, error: SpikeserveError) -> SpikeserveError:
        """Returns `error` with the reason why the server was not reached, if that is the reason."""
        if not is_retryable(error):
            return error
        reason = diagnose(self.server, self._encrypts, error.message)
        if reason is None:
            return error
        message = f"no connection to {self.server}: {reason}"
        return make_error(error.call, grpc.StatusCode.UNAVAILABLE, message)

    def _patience(self) -> Patience:
        """Returns the patience of a stream that breaks now."""
        options = self._options
        return Patience(options.retry, None if self._reached else options.connect_timeout)

    def _attempts(self, call: Call[Any]) -> Attempts:
        options = self._options
        unknown = None if self._reached else options.connect_timeout
        return Attempts(call, options.retry, options.timeout, unknown)

    def _send(self, call: Call[Any], request: Message, timeout: float) -> Any:
        """Starts one attempt. Returns the response, or with grpc.aio an awaitable of it."""
        metadata = self._options.metadata
        return self._methods[call.method](request, timeout=timeout, metadata=metadata)

    def _open_stream(self, *requests: Iterable[Message]) -> Any:
        return self._methods[ACT_STREAM.name](*requests, metadata=self._options.metadata)


class Connection(_Channel):
    """Runs calls and blocks until they end. Thread-safe."""

    _transport = grpc

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. The server keeps every session that was not closed."""
        self._channel.close()

    def run(self, call: Call[T]) -> T:
        """Returns the value of `call`. Repeats failed attempts as the options say."""
        attempts = self._attempts(call)
        response = self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_for(failed.error)
            if pause is None:
                break
            time.sleep(pause)
            failed.merge(self._response(call, failed.request, attempts))
        return call.decode(response)

    def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            try:
                response = self._send(call, request, attempts.timeout())
            except grpc.RpcError as error:
                self._reached = self._reached or not is_retryable_code(error.code())
                try:
                    pause = attempts.pause_after(error)
                except SpikeserveError as last:
                    # A call of a connection that was made once must fail without delay.
                    raise last if self._reached else self._explain(last) from error
            else:
                self._reached = True
                return response
            if pause is None:
                return self._table[call.method].response()
            time.sleep(pause)

    def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Returns the response of the unary method `name`, for example of Explain."""
        return self.run(Call(name, request, lambda response: response, timeout))


class AsyncConnection(_Channel):
    """Runs calls with asyncio, any number of them at once. Belongs to one event loop."""

    _transport = grpc.aio

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Asyncio form of Connection.close."""
        await self._channel.close()

    async def run(self, call: Call[T]) -> T:
        """Asyncio form of Connection.run."""
        attempts = self._attempts(call)
        response = await self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_for(failed.error)
            if pause is None:
                break
            await asyncio.sleep(pause)
            failed.merge(await self._response(call, failed.request, attempts))
        return call.decode(response)

    async def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            try:
                response = await self._send(call, request, attempts.timeout())
            except grpc.RpcError as error:
                self._reached = self._reached or not is_retryable_code(error.code())
                try:
                    pause = attempts.pause_after(error)
                except SpikeserveError as last:
                    if self._reached:
                        raise
                    raise await asyncio.to_thread(self._explain, last) from error
            else:
                self._reached = True
                return response
            if pause is None:
                return self._table[call.method].response()
            await asyncio.sleep(pause)

    async def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Asyncio form of Connection.call."""
        return await self.run(Call(name, request, lambda response: response, timeout))
