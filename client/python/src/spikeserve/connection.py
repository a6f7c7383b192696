"""The connections of a client to its servers: `Connection` blocks, `AsyncConnection` awaits.

Only these two classes send unary calls, wait for responses and repeat failed attempts.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import grpc
import grpc.aio

from spikeserve.calls import Call
from spikeserve.check import check
from spikeserve.cursor import SessionCursor
from spikeserve.diagnosis import diagnose
from spikeserve.errors import (
    FailedPreconditionError,
    SpikeserveError,
    expected_decision,
    is_retryable,
    is_retryable_code,
    make_error,
)
from spikeserve.replicas import (
    AFFINITY_KEY,
    PROBE_SECONDS,
    Replica,
    Replicas,
    Route,
    draw_id,
    parse_servers,
)
from spikeserve.retry import Attempts, Patience, RetryOptions
from spikeserve.wire import ACT_STREAM, METHODS, Message, Method

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

T = TypeVar("T")


def default_server() -> str:
    """Returns the addresses in the environment variable SPIKESERVE_SERVER, or 127.0.0.1:50051."""
    return os.environ.get("SPIKESERVE_SERVER") or "127.0.0.1:50051"


# The C++ client sets the same options. Each client has its own connection, and reconnects to a
# restarted server within one second. The default of gRPC is two minutes.
CHANNEL_OPTIONS = [
    ("grpc.use_local_subchannel_pool", 1),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1000),
]


# grpc.health.v1.Health.Check, with serialized messages: an empty request, and status = SERVING.
_HEALTH_CHECK = "/grpc.health.v1.Health/Check"
_SERVING = b"\x08\x01"


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


class _Channels:
    """The gRPC channels to the servers and the methods of a service on them, blocking or not."""

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
        self._encrypts = credentials is not None
        self._reached = False  # whether a server has answered a call
        self.replicas = Replicas(
            [self._connect(address, credentials) for address in parse_servers(self.server)],
            self._options.retry.initial_backoff,
            self._options.retry.max_backoff,
            self._probe,
        )

    def _connect(self, address: str, credentials: grpc.ChannelCredentials | None) -> Replica:
        if credentials is None:
            channel = self._transport.insecure_channel(address, CHANNEL_OPTIONS)
        else:
            channel = self._transport.secure_channel(address, credentials, CHANNEL_OPTIONS)
        methods = {name: method.bind(channel) for name, method in self._table.items()}
        return Replica(address, channel, methods, channel.unary_unary(_HEALTH_CHECK))

    def _probe(self, replica: Replica) -> None:
        """Starts a health check of a server that is away and passes the result to Replicas."""
        raise NotImplementedError

    def _explain(self, error: SpikeserveError, replica: Replica) -> SpikeserveError:
        """Returns `error` with the reason why the server was not reached, if that is the reason."""
        if not is_retryable(error):
            return error
        reason = diagnose(replica.address, self._encrypts, error.message)
        if reason is None:
            return error
        message = f"no connection to {replica.address}: {reason}"
        return make_error(error.call, grpc.StatusCode.UNAVAILABLE, message)

    def patience(self) -> Patience:
        """Returns the patience of a stream that breaks now."""
        options = self._options
        return Patience(options.retry, None if self._reached else options.connect_timeout)

    def _attempts(self, call: Call[Any]) -> Attempts:
        options = self._options
        unknown = None if self._reached else options.connect_timeout
        return Attempts(call, options.retry, options.timeout, unknown, self.replicas)

    def metadata(self, route: Route) -> Sequence[tuple[str, str]]:
        """Returns the gRPC metadata of a call."""
        affinity = ((AFFINITY_KEY, route.key),) if route.key else ()
        return (*self._options.metadata, *affinity)

    def _send(self, replica: Replica, call: Call[Any], request: Message, timeout: float) -> Any:
        """Starts one attempt. Returns the response, or with grpc.aio an awaitable of it."""
        return replica.methods[call.method](
            request, timeout=timeout, metadata=self.metadata(call.route)
        )

    @property
    def options(self) -> ClientOptions:
        """Returns the settings of the client."""
        return self._options


class StreamOpener:
    """Opens the calls of one stream: at another server if the first one is gone."""

    def __init__(self, channels: _Channels) -> None:
        self._channels = channels
        self.route = Route(draw_id())
        self._replica = channels.replicas.choose(self.route)

    def open(self, *requests: Iterable[Message]) -> Any:
        """Opens a call at the preferred server."""
        self._replica = self._channels.replicas.choose(self.route)
        metadata = self._channels.metadata(self.route)
        return self._replica.methods[ACT_STREAM.name](*requests, metadata=metadata)

    def take(self, cursor: SessionCursor) -> None:
        """Lets all calls of a session go to the server of the stream from now on.

        ValueError if the session exists at another server only.
        """
        if not cursor.route.is_pinned or len(self._channels.replicas) == 1:
            cursor.route = self.route
            return
        other = cursor.route.replica
        address = self._replica.address
        expected = f"one that is stored, or opened with the route of the stream, at {address}"
        check(other is self._replica, "session", expected, f"one at {other and other.address}")

    def answered(self) -> None:
        """Notes an answer."""
        self._channels.replicas.answered(self.route, self._replica)

    def failed(self) -> None:
        """Notes that the server ended the call, or did not answer for the timeout of a call."""
        self._channels.replicas.failed(self._replica)

    @property
    def has_others(self) -> bool:
        """Returns whether the stream may go to another server."""
        return self._channels.replicas.may_move(self.route)


class Connection(_Channels):
    """Runs calls and blocks until they end. Thread-safe."""

    _transport = grpc

    def _probe(self, replica: Replica) -> None:
        metadata = self._options.metadata
        check = replica.health.future(b"", timeout=PROBE_SECONDS, metadata=metadata)
        check.add_done_callback(lambda done: self.replicas.probed(replica, _serves(done)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. The server keeps every session that was not closed."""
        for replica in self.replicas:
            replica.channel.close()

    def run(self, call: Call[T]) -> T:
        """Returns the value of `call`. Repeats failed attempts as the options say.

        Sends decisions again that the server expects and that were made before.
        """
        attempts = self._attempts(call)
        while True:
            try:
                return self._run_with(call, attempts)
            except FailedPreconditionError as error:
                missing = call.missing(error) if call.missing is not None else []
                pause = attempts.pause_before_missing() if missing else None
                if pause is None:
                    raise
            time.sleep(pause)
            self._send_missing(missing, attempts)

    def _run_with(self, call: Call[T], attempts: Attempts) -> T:
        response = self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_before_part(failed)
            if pause is None:
                break
            time.sleep(pause)
            self._send_missing(failed.missing, attempts)
            failed.merge(self._response(call, failed.request, attempts))
        return call.decode(response)

    def _send_missing(self, missing: Sequence[Call[None]], attempts: Attempts) -> None:
        for part in missing:
            try:
                self._run_with(part, attempts)
            except SpikeserveError as error:
                # The call that follows says what is still missing.
                if not is_retryable(error) and expected_decision(error) is None:
                    raise

    def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            replica, timeout = attempts.replica, attempts.timeout()
            try:
                response = self._send(replica, call, request, timeout)
            except grpc.RpcError as error:
                self._reached = self._reached or not is_retryable_code(error.code())
                try:
                    pause = attempts.pause_after(error, timeout)
                except SpikeserveError as last:
                    # A call of a connection that was made once must fail without delay.
                    raise last if self._reached else self._explain(last, replica) from error
            else:
                self._reached = True
                attempts.answered()
                return response
            if pause is None:
                return self._table[call.method].response()
            time.sleep(pause)

    def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Returns the response of the unary method `name`, for example of Explain."""
        return self.run(Call(name, request, lambda response: response, timeout))


class AsyncConnection(_Channels):
    """Runs calls with asyncio, any number of them at once. Belongs to one event loop."""

    _transport = grpc.aio

    def __init__(
        self,
        server: str | None = None,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        super().__init__(server, options, credentials)
        self._probes: set[asyncio.Task[None]] = set()
        self._is_closed = False

    def _probe(self, replica: Replica) -> None:
        if self._is_closed:  # calls that were under way fail then
            return
        task = asyncio.create_task(self._check_health(replica))
        self._probes.add(task)
        task.add_done_callback(self._probes.discard)

    async def _check_health(self, replica: Replica) -> None:
        metadata = self._options.metadata
        try:
            answer = await replica.health(b"", timeout=PROBE_SECONDS, metadata=metadata)
            serves = answer == _SERVING
        except grpc.RpcError as error:
            serves = not is_retryable_code(error.code())
        self.replicas.probed(replica, serves)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Asyncio form of Connection.close."""
        self._is_closed = True
        for probe in self._probes:
            probe.cancel()
        for replica in self.replicas:
            await replica.channel.close()

    async def run(self, call: Call[T]) -> T:
        """Asyncio form of Connection.run."""
        attempts = self._attempts(call)
        while True:
            try:
                return await self._run_with(call, attempts)
            except FailedPreconditionError as error:
                missing = call.missing(error) if call.missing is not None else []
                pause = attempts.pause_before_missing() if missing else None
                if pause is None:
                    raise
            await asyncio.sleep(pause)
            await self._send_missing(missing, attempts)

    async def _run_with(self, call: Call[T], attempts: Attempts) -> T:
        response = await self._response(call, call.request, attempts)
        while call.failed_items is not None and (failed := call.failed_items(response)):
            pause = attempts.pause_before_part(failed)
            if pause is None:
                break
            await asyncio.sleep(pause)
            await self._send_missing(failed.missing, attempts)
            failed.merge(await self._response(call, failed.request, attempts))
        return call.decode(response)

    async def _send_missing(self, missing: Sequence[Call[None]], attempts: Attempts) -> None:
        for part in missing:
            try:
                await self._run_with(part, attempts)
            except SpikeserveError as error:
                if not is_retryable(error) and expected_decision(error) is None:
                    raise

    async def _response(self, call: Call[Any], request: Message, attempts: Attempts) -> Message:
        while True:
            replica, timeout = attempts.replica, attempts.timeout()
            try:
                response = await self._send(replica, call, request, timeout)
            except grpc.RpcError as error:
                self._reached = self._reached or not is_retryable_code(error.code())
                try:
                    pause = attempts.pause_after(error, timeout)
                except SpikeserveError as last:
                    if self._reached:
                        raise
                    raise await asyncio.to_thread(self._explain, last, replica) from error
            else:
                self._reached = True
                attempts.answered()
                return response
            if pause is None:
                return self._table[call.method].response()
            await asyncio.sleep(pause)

    async def call(self, name: str, request: Message, timeout: float | None = None) -> Message:
        """Asyncio form of Connection.call."""
        return await self.run(Call(name, request, lambda response: response, timeout))


def _serves(check: Any) -> bool:
    """Returns whether the server of a finished health check serves, which may not have Health."""
    try:
        return bool(check.result() == _SERVING)
    except grpc.RpcError as error:
        return not is_retryable_code(error.code())
    except grpc.FutureCancelledError:
        return False
