"""`Channels`: the lines of a client to its servers, and its settings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import grpc

from spikeserve.calls import Call
from spikeserve.check import check
from spikeserve.diagnosis import diagnose
from spikeserve.errors import SpikeserveError, is_retryable, is_retryable_code, make_error
from spikeserve.lines import (
    LONGEST_SECONDS,
    Line,
    LineRenewedError,
    channel_options,
    is_answer,
)
from spikeserve.replicas import AFFINITY_KEY, Replica, Replicas, Route, parse_servers
from spikeserve.retry import Attempts, Patience, RetryOptions
from spikeserve.trace_context import TRACEPARENT, active_traceparent
from spikeserve.wire import METHODS, Message, Method


def default_server() -> str:
    """Returns the addresses in the environment variable SPIKESERVE_SERVER, or 127.0.0.1:50051."""
    return os.environ.get("SPIKESERVE_SERVER") or "127.0.0.1:50051"


def default_token() -> str:
    """Returns the environment variable SPIKESERVE_TOKEN, without white space around it."""
    return os.environ.get("SPIKESERVE_TOKEN", "").strip()


@dataclass(frozen=True)
class ClientOptions:
    """Settings of a client. ValueError if a field is out of its range."""

    timeout: float = 5.0  # seconds for each attempt of a call; of an AdminClient, this means 60
    connect_timeout: float = 3.0  # seconds of attempts to reach a server for the first time
    retry: RetryOptions = field(default_factory=RetryOptions)
    # While a call is under way, a server that has sent nothing for `keepalive` seconds is asked for
    # a sign of life (a PING of HTTP/2), which may take `keepalive_timeout` seconds. So may the
    # acknowledgement of sent bytes (TCP_USER_TIMEOUT). After that, the connection is a broken one.
    keepalive: float = 10.0
    keepalive_timeout: float = 5.0
    # Sent with every call, printable ASCII. The default is that of `default_token`.
    token: str = field(default_factory=default_token, repr=False)

    def __post_init__(self) -> None:
        check(self.timeout > 0, "timeout", "more than 0", self.timeout)
        least = self.connect_timeout
        check(least >= 0, "connect_timeout", "at least 0", least)
        check(self.keepalive > 0, "keepalive", "more than 0", self.keepalive)
        patience = self.keepalive_timeout
        check(patience > 0, "keepalive_timeout", "more than 0", patience)
        is_legal = self.token.isascii() and self.token.isprintable()
        check(is_legal, "token", "printable ASCII characters", "others")

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """Returns the gRPC metadata of every call."""
        return (("authorization", f"Bearer {self.token}"),) if self.token else ()


class Channels:
    """The gRPC channels to the servers and the methods of a service on them, blocking or not."""

    _transport: ClassVar[Any]  # grpc or grpc.aio, whose functions have the same names
    _table: ClassVar[dict[str, Method]] = METHODS  # the methods of the service by name
    _default_timeout: ClassVar[float] = ClientOptions.timeout

    def __init__(
        self,
        server: str | None = None,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        self._options = options or ClientOptions()
        if self._options.timeout == ClientOptions.timeout:
            self._options = replace(self._options, timeout=self._default_timeout)
        self.server = default_server() if server is None else server
        self._credentials = credentials
        self._reached = False  # whether a server has answered a call
        self._is_closed = False
        self.replicas = Replicas(
            [Replica(a, self._connect(a)) for a in parse_servers(self.server)],
            self._options.retry.initial_backoff,
            self._options.retry.max_backoff,
            self._probe,
        )

    def _connect(self, address: str) -> Line:
        options = channel_options(self._options.keepalive, self._options.keepalive_timeout)
        if self._credentials is None:
            channel = self._transport.insecure_channel(address, options)
        else:
            channel = self._transport.secure_channel(address, self._credentials, options)
        return Line.on(channel, self._table)

    def suspect(self, replica: Replica, since: float) -> None:
        """Races a fresh connection if a call has waited since `since` (time.monotonic())."""
        if replica.doubt.waits(since):
            self._start_race(replica)

    def _start_race(self, replica: Replica) -> None:
        """Starts a race and passes the result to the doubt of the replica."""
        raise NotImplementedError

    def _note_failure(
        self, error: grpc.RpcError, replica: Replica, line: Line, began: float
    ) -> grpc.RpcError:
        """Notes the end of a call on `line`. Returns its error, or the one that it stands for."""
        self._reached = self._reached or not is_retryable_code(error.code())
        if error.code() == grpc.StatusCode.CANCELLED and line is not replica.line:
            return LineRenewedError()
        if is_answer(error.code()):
            replica.doubt.answered()
        elif error.code() == grpc.StatusCode.DEADLINE_EXCEEDED and line is replica.line:
            if replica.doubt.missed(began):
                self._start_race(replica)
        return error

    def _probe(self, replica: Replica) -> None:
        """Starts a health check of a server that is away and passes the result to Replicas."""
        raise NotImplementedError

    def _explain(self, error: SpikeserveError, replica: Replica) -> SpikeserveError:
        """Returns `error` with the reason why the server was not reached, if that is the reason."""
        if not is_retryable(error):
            return error
        reason = diagnose(replica.address, self._credentials is not None, error.message)
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
        # The id of a session that does not exist may be any text.
        is_legal = route.key.isascii() and route.key.isprintable()
        affinity = ((AFFINITY_KEY, route.key),) if route.key and is_legal else ()
        active = active_traceparent()
        trace = ((TRACEPARENT, active),) if active else ()
        return (*self._options.metadata, *affinity, *trace)

    def _send(self, line: Line, call: Call[Any], request: Message, timeout: float) -> Any:
        """Starts one attempt. Returns the response, or with grpc.aio an awaitable of it."""
        timeout = min(timeout, LONGEST_SECONDS)
        return line.methods[call.method](
            request, timeout=timeout, metadata=self.metadata(call.route)
        )

    @property
    def credentials(self) -> grpc.ChannelCredentials | None:
        """Returns the credentials of the connection; None: plain text."""
        return self._credentials

    @property
    def options(self) -> ClientOptions:
        """Returns the settings of the client."""
        return self._options
