"""The part of a stream that the blocking and the asyncio client share. Nothing here waits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic

import grpc
from numpy.typing import ArrayLike

from spikeserve.check import check
from spikeserve.errors import (
    SessionLostError,
    SpikeserveError,
    error_of_item,
    for_session,
    make_error,
    was_refused,
)
from spikeserve.retry import Patience, RetryOptions
from spikeserve.session_handle import AnySession
from spikeserve.values import ActionLike, Decision
from spikeserve.wire import Message


@dataclass
class OpenRequest(Generic[AnySession]):
    """A request without an answer."""

    session: AnySession
    observation: ArrayLike
    message: Message
    patience: Patience
    due: float | None = None  # when to send it again, of time.monotonic(); None: it is under way


class OpenRequests(Generic[AnySession]):
    """The sessions that wait for an answer on a stream, with one open request each."""

    def __init__(self, retry: RetryOptions, new_patience: Callable[[], Patience]) -> None:
        self._retry = retry
        self._new_patience = new_patience  # of a stream that breaks
        self._open: dict[str, OpenRequest[AnySession]] = {}
        self._stream_patience: Patience | None = None  # None: the stream is whole
        self.broken: SpikeserveError | None = None  # why the stream broke; None: it is open

    def __len__(self) -> int:
        return len(self._open)

    def add(
        self,
        session: AnySession,
        observation: ArrayLike,
        reward: float | None,
        executed_action: ActionLike | None,
    ) -> Message:
        """Returns the request to send. ValueError if the session has an open request already."""
        session_id = session.session_id
        is_idle = session_id not in self._open
        check(is_idle, f"session {session_id}", "no request under way", "one")
        request = session.cursor.act(observation, reward, None, executed_action).request
        patience = Patience(self._retry)
        self._open[session_id] = OpenRequest(session, observation, request, patience)
        return request

    def check_empty(self) -> None:
        """ValueError if any session has an open request."""
        check(not self._open, "stream", "no request under way", len(self._open))

    def accept(
        self, reply: Message
    ) -> tuple[AnySession, Decision | SpikeserveError] | OpenRequest[AnySession] | None:
        """Returns the session that `reply` is for, and its decision or error.

        A decision moves the session to its next step. An error does not. Returns None if the server
        refused the request for now, which will be due again. Returns the request if its session was
        lost and reopens: the caller opens the session again and passes the request to `restart`.
        """
        request = self._open.pop(reply.session_id, None)
        if request is None:
            raise make_error(
                "ActStream",
                grpc.StatusCode.INTERNAL,
                f"session_id: expected one with a request under way, received {reply.session_id}",
            )
        self._stream_patience = None
        session = request.session
        if not reply.HasField("error"):
            return session, session.cursor.accept(reply)
        error = _error_of(reply)
        if was_refused(error):
            pause = request.patience.pause_after(error)
            if pause is not None:
                request.due = time.monotonic() + pause
                self._open[session.session_id] = request
                return None
        if isinstance(error, SessionLostError) and session.reopens:
            return request
        return session, error

    def restart(self, request: OpenRequest[AnySession]) -> Message:
        """Returns the request to send after its session was opened again."""
        return self.add(request.session, request.observation, 0.0, None)

    def seconds_until_due(self) -> float | None:
        """Returns the time until a refused request has to be sent again; None: there is none."""
        due = [request.due for request in self._open.values() if request.due is not None]
        return max(0.0, min(due) - time.monotonic()) if due else None

    def take_due(self) -> Iterable[Message]:
        """Returns the refused requests that are due, which count as under way again."""
        now = time.monotonic()
        for request in self._open.values():
            if request.due is not None and request.due <= now:
                request.due = None
                yield request.message

    def all_messages(self) -> Iterable[Message]:
        """Returns every open request, to send it on a new stream."""
        for request in self._open.values():
            request.due = None
            yield request.message

    def may_reopen(self) -> bool:
        """Returns whether the policy for retries allows a second stream after a broken one."""
        return self._retry.max_attempts != 1 and self._retry.max_elapsed > 0

    def pause_after_break(self, error: SpikeserveError) -> float | None:
        """Returns the seconds to wait before a new stream is opened; None: the stream stays broken.

        A broken stream has no open requests: each of them may be sent again.
        """
        self._stream_patience = self._stream_patience or self._new_patience()
        pause = self._stream_patience.pause_after(error) if self._open else None
        if pause is None:
            self.broken = error
            self._stream_patience = None
            self._open.clear()
        return pause


def _error_of(reply: Message) -> SpikeserveError:
    delay = reply.error.retry_after_seconds
    known = reply.error.HasField("retry_after_seconds")
    error = error_of_item(
        "ActStream", reply.error.code, reply.error.message, delay if known else None
    )
    return for_session(error, reply.session_id)


def stream_ended() -> SpikeserveError:
    """Returns the error for a stream that the server has ended."""
    return make_error("ActStream", grpc.StatusCode.UNAVAILABLE, "the server ended the stream")


def stream_closed() -> SpikeserveError:
    """Returns the error for a stream that its owner has closed."""
    return make_error("ActStream", grpc.StatusCode.CANCELLED, "the stream was closed")
