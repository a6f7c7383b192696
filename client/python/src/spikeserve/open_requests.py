"""The part of a stream that the blocking and the asyncio client share. Nothing here waits."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic

import grpc
from numpy.typing import ArrayLike

from spikeserve.calls import Call
from spikeserve.channels import ClientOptions
from spikeserve.check import check
from spikeserve.errors import (
    SessionLostError,
    SpikeserveError,
    error_of_item,
    for_session,
    is_retryable,
    make_error,
    was_refused,
)
from spikeserve.lines import SILENCE_SECONDS
from spikeserve.retry import Patience
from spikeserve.session_handle import AnySession
from spikeserve.stream_opener import StreamOpener
from spikeserve.values import Decision, ExecutedLike
from spikeserve.wire import Message


@dataclass
class OpenRequest(Generic[AnySession]):
    """A request without an answer."""

    session: AnySession
    observation: ArrayLike
    call: Call[Decision]
    patience: Patience
    sent: float = field(default_factory=time.monotonic)
    due: float | None = None  # when to send it again, of time.monotonic(); None: it is under way
    failures: int = 0  # how often the server could not answer it now


class OpenRequests(Generic[AnySession]):
    """The sessions that wait for an answer on a stream, with one open request each.

    Requests go to the server that `opener` has chosen, and so do all other calls of the sessions.
    `timeout` is how long an answer may take, in seconds, if there is another server.
    """

    def __init__(
        self,
        opener: StreamOpener,
        options: ClientOptions,
        new_patience: Callable[[], Patience],
    ) -> None:
        self._opener = opener
        self._retry = options.retry
        self._timeout = options.timeout
        self._new_patience = new_patience  # of a stream that breaks
        self._open: dict[str, OpenRequest[AnySession]] = {}
        self._stream_patience: Patience | None = None  # None: the stream is whole
        self._doubted = 0.0  # when `doubt` was called last, of time.monotonic()
        self.broken: SpikeserveError | None = None  # why the stream broke; None: it is open

    def __len__(self) -> int:
        return len(self._open)

    def add(
        self,
        session: AnySession,
        observation: ArrayLike,
        reward: float | None,
        executed_action: ExecutedLike | None,
    ) -> Message:
        """Returns the request to send. ValueError if the session has an open request already."""
        session_id = session.session_id
        is_idle = session_id not in self._open
        check(is_idle, f"session {session_id}", "no request under way", "one")
        self._opener.take(session.cursor)
        call = session.cursor.act(observation, reward, None, executed_action)
        self._open[session_id] = OpenRequest(session, observation, call, Patience(self._retry))
        return call.request

    def check_empty(self) -> None:
        """ValueError if any session has an open request."""
        check(not self._open, "stream", "no request under way", len(self._open))

    def accept(
        self, reply: Message
    ) -> (
        tuple[AnySession, Decision | SpikeserveError]
        | OpenRequest[AnySession]
        | SpikeserveError
        | None
    ):
        """Returns the session that `reply` is for, and its decision or error.

        A decision moves the session to its next step. An error does not. Returns None if the server
        cannot answer the request now, which will be due again, and the error if another stream may.
        Returns the request if its session is not at this server, or misses decisions there: the
        caller makes `call` outside of the stream, which finds the session.
        """
        request = self._open.pop(reply.session_id, None)
        if request is None and not reply.session_id and not reply.HasField("error"):
            # A server names the session. A proxy that has lost its server ends the stream with a
            # page.
            return stream_ended("the stream has ended with an empty message")
        if request is None:
            raise make_error(
                "ActStream",
                grpc.StatusCode.INTERNAL,
                f"session_id: expected one with a request under way, received {reply.session_id}",
            )
        self._stream_patience = None
        self._opener.answered()
        session = request.session
        if not reply.HasField("error"):
            return session, request.call.decode(reply)
        error = for_session(error_of_item("ActStream", reply.error), reply.session_id)
        if was_refused(error) or is_retryable(error):
            request.failures += 1
            pause = request.patience.pause_after(error)
            if pause is not None:
                request.due = time.monotonic() + pause
                self._open[session.session_id] = request
                is_elsewhere = is_retryable(error) and request.failures > 1
                return error if is_elsewhere and self._opener.has_others else None
        cursor = session.cursor
        is_elsewhere = isinstance(error, SessionLostError) or cursor.is_outdated(error)
        if is_elsewhere or cursor.missing(error):
            return request
        return session, error

    def seconds_until_silent(self) -> float | None:
        """Returns the seconds until `is_silent` may be true; None: it never will be."""
        if not self._opener.has_others:
            return None
        oldest = self._oldest() or time.monotonic()
        return max(0.0, oldest + self._timeout - time.monotonic())

    def is_silent(self) -> bool:
        """Returns whether a request has had no answer for too long, and another server may have."""
        return bool(self._open) and self.seconds_until_silent() == 0.0

    def seconds_until_doubt(self) -> float | None:
        """Returns the seconds until `doubt` is to be called; None: no answer is awaited."""
        oldest = self._oldest()
        if oldest is None:
            return None
        return max(0.0, max(oldest, self._doubted) + SILENCE_SECONDS - time.monotonic())

    def doubt(self) -> None:
        """Races a fresh connection if the oldest request has waited for too long."""
        oldest = self._oldest()
        if oldest is not None and self.seconds_until_doubt() == 0.0:
            self._doubted = time.monotonic()
            self._opener.suspect(oldest)

    def _oldest(self) -> float | None:
        sent = (request.sent for request in self._open.values() if request.due is None)
        return min(sent, default=None)

    def restart(self, request: OpenRequest[AnySession]) -> Message:
        """Returns the request to send after its session was opened again."""
        return self.add(request.session, request.observation, 0.0, None)

    def seconds_until_due(self) -> float | None:
        """Returns the time until a refused request has to be sent again; None: there is none."""
        due = [request.due for request in self._open.values() if request.due is not None]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def take_due(self) -> list[Message]:
        """Returns the refused requests that are due, which count as under way again."""
        now = time.monotonic()
        due = (r for r in self._open.values() if r.due is not None and r.due <= now)
        return [self._send(request) for request in due]

    def all_messages(self) -> list[Message]:
        """Returns every open request, to send it on a new stream."""
        return [self._send(request) for request in self._open.values()]

    @staticmethod
    def _send(request: OpenRequest[AnySession]) -> Message:
        request.due = None
        request.sent = time.monotonic()
        return request.call.request

    def may_reopen(self) -> bool:
        """Returns whether the policy for retries allows a second stream after a broken one."""
        return self._retry.max_attempts != 1 and self._retry.max_elapsed > 0

    def pause_after_break(self, error: SpikeserveError) -> float | None:
        """Returns the seconds to wait before a new stream is opened; None: the stream stays broken.

        A broken stream has no open requests: each of them may be sent again.
        """
        self._opener.failed()
        self._stream_patience = self._stream_patience or self._new_patience()
        pause = self._stream_patience.pause_after(error) if self._open else None
        if pause is None:
            self.broken = error
            self._stream_patience = None
            self._open.clear()
        return pause


def stream_ended(message: str = "the server ended the stream") -> SpikeserveError:
    """Returns the error for a stream that the server has ended."""
    return make_error("ActStream", grpc.StatusCode.UNAVAILABLE, message)


def stream_silent() -> SpikeserveError:
    """Returns the error for a stream whose server has not answered for too long."""
    return make_error("ActStream", grpc.StatusCode.DEADLINE_EXCEEDED, "no answer in time")


def stream_closed() -> SpikeserveError:
    """Returns the error for a stream that its owner has closed."""
    return make_error("ActStream", grpc.StatusCode.CANCELLED, "the stream was closed")
