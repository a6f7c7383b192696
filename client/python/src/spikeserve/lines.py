"""The connection to one server, and the race of a fresh one against one that does not answer.

A NAT, a firewall or a mobile network may forget a connection and drop its packets without a word,
while new connections work. The keepalive of HTTP/2 finds that out after seconds. Therefore a fresh
connection is tried as soon as answers are missing: both get a health check, and if the fresh one
answers first, and the old one not within GRACE_SECONDS of that, it takes its place. Nothing here
waits, except `LineWatch`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import grpc

from spikeserve.errors import is_retryable_code
from spikeserve.wire import Method

# grpc.health.v1.Health.Check, with serialized messages: an empty request, and status = SERVING.
HEALTH_CHECK = "/grpc.health.v1.Health/Check"
SERVING = b"\x08\x01"

MISSES = 3  # calls in a row without an answer in time, before a race
SILENCE_SECONDS = 0.3  # without any answer while calls wait for one, before a race
RACE_SECONDS = 1.0  # for the two health checks
GRACE_SECONDS = 0.05  # for the old line: on a busy machine, answers change places
FIRST_PAUSE = 0.1  # seconds after a race that the fresh connection has not won, doubled each time
LONGEST_PAUSE = 5.0
LONGEST_SECONDS = 50 * 365 * 86400.0  # clocks that count nanoseconds have no much later times


def channel_options(keepalive: float, keepalive_timeout: float) -> list[tuple[str, int]]:
    """Returns the options of a channel; the C++ client sets the same.

    Each client has its own connection, and reconnects to a restarted server within a third of a
    second (the default of gRPC is two minutes). An attempt to connect ends after two seconds, not
    twenty: the pauses between repeated SYN packets grow. gRPC sets TCP_USER_TIMEOUT to
    `keepalive_timeout`.
    """

    def milliseconds(seconds: float) -> int:
        return round(min(max(1000 * seconds, 1), (1 << 31) - 1))

    return [
        ("grpc.use_local_subchannel_pool", 1),
        ("grpc.enable_retries", 0),  # the client repeats calls, and knows which ones it may repeat
        ("grpc.initial_reconnect_backoff_ms", 100),
        ("grpc.max_reconnect_backoff_ms", 300),
        ("grpc.min_reconnect_backoff_ms", 2000),
        ("grpc.keepalive_time_ms", milliseconds(keepalive)),
        ("grpc.keepalive_timeout_ms", milliseconds(keepalive_timeout)),
        ("grpc.http2.ping_timeout_ms", milliseconds(keepalive_timeout)),
        ("grpc.http2.max_pings_without_data", 0),
        ("grpc.max_receive_message_length", 1 << 28),  # a policy file may be large
    ]


@dataclass(frozen=True)
class Line:
    """A channel to a server with the methods of a service on it."""

    channel: Any
    methods: dict[str, Any]
    health: Any  # grpc.health.v1.Health.Check, of serialized messages

    @classmethod
    def on(cls, channel: Any, table: dict[str, Method]) -> Line:
        """Returns the line on a channel of grpc or grpc.aio."""
        methods = {name: method.bind(channel) for name, method in table.items()}
        return cls(channel, methods, channel.unary_unary(HEALTH_CHECK))


class LineRenewedError(grpc.RpcError):  # type: ignore[misc]
    """The end of a call whose line was replaced by a fresh one. It may be sent again."""

    def code(self) -> grpc.StatusCode:
        """Returns the status."""
        return grpc.StatusCode.UNAVAILABLE

    def details(self) -> str:
        """Returns the message."""
        return "the connection did not answer and was replaced by a fresh one"


class Doubt:
    """Decides when the line of a server has been silent for so long that a race begins.

    Thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._misses = 0
        self._silent_since: float | None = None  # of time.monotonic(); None: it answered
        self._answered_at = 0.0
        self._is_racing = False
        self._next_race = 0.0
        self._pause = FIRST_PAUSE

    def answered(self) -> None:
        """Notes an answer of the server, of whatever kind."""
        self._answered_at = time.monotonic()
        self._misses = 0
        self._silent_since = None

    def missed(self, began: float) -> bool:
        """Notes a call that began at `began` and had no answer in time. Returns whether to race."""
        with self._lock:
            if began < self._answered_at:
                return False
            self._misses += 1
            since = began if self._silent_since is None else min(began, self._silent_since)
            self._silent_since = since
            return self._misses >= MISSES and self._take(since)

    def waits(self, since: float) -> bool:
        """Returns whether to race because a call has waited for its answer since `since`."""
        with self._lock:
            return self._take(max(since, self._answered_at))

    def raced(self, fresh_won: bool) -> None:
        """Notes the end of a race."""
        with self._lock:
            self._is_racing = False
            self._pause = FIRST_PAUSE if fresh_won else min(2 * self._pause, LONGEST_PAUSE)
            self._next_race = time.monotonic() + self._pause
            self._misses = 0
            self._silent_since = None

    def _take(self, silent_since: float) -> bool:
        now = time.monotonic()
        if self._is_racing or now < self._next_race or now - silent_since < SILENCE_SECONDS:
            return False
        self._is_racing = True
        return True


def is_answer(code: grpc.StatusCode) -> bool:
    """Returns whether a server or a proxy has answered a call that ended with `code`."""
    return not is_retryable_code(code) and code != grpc.StatusCode.CANCELLED


def has_answered(check: Any) -> bool:
    """Returns whether a finished health check of grpc was answered, whatever the answer is."""
    if check.cancelled():
        return False
    error = check.exception()
    return error is None or is_answer(error.code())


Place = TypeVar("Place")


class LineWatch(Generic[Place]):
    """Watches blocking calls under way, on a thread that ends when there are none for a while.

    Calls `suspect` with the place of a call (its server) that has waited for SILENCE_SECONDS, and
    the time at which it began. Thread-safe.
    """

    def __init__(self, suspect: Callable[[Place, float], None]) -> None:
        self._suspect = suspect
        self._calls: dict[object, tuple[Place, float]] = {}
        self._lock = threading.Lock()
        self._is_running = False

    def begin(self, place: Place, began: float) -> object:
        """Notes a call that begins. Returns what `end` takes."""
        call = object()
        self._calls[call] = (place, began)
        if not self._is_running:
            with self._lock:
                if not self._is_running:
                    self._is_running = True
                    name = "spikeserve-line-watch"
                    threading.Thread(target=self._run, name=name, daemon=True).start()
        return call

    def end(self, call: object) -> None:
        """Notes that a call has ended."""
        self._calls.pop(call, None)

    def _run(self) -> None:
        idle_since = time.monotonic()
        while True:
            time.sleep(SILENCE_SECONDS / 3)
            now = time.monotonic()
            calls = list(self._calls.values())
            if calls:
                idle_since = now
            elif now - idle_since > 1.0:
                with self._lock:
                    if not self._calls:
                        self._is_running = False
                        return
            for place, began in calls:
                if now - began >= SILENCE_SECONDS:
                    self._suspect(place, began)
