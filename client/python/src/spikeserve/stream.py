"""`ActStream`: the decisions of any number of sessions on one blocking stream."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import grpc
from numpy.typing import ArrayLike

from spikeserve.connection import Connection
from spikeserve.errors import SessionLostError, SpikeserveError, error_of_call, make_error
from spikeserve.open_requests import (
    OpenRequest,
    OpenRequests,
    stream_closed,
    stream_ended,
    stream_silent,
)
from spikeserve.replicas import Route
from spikeserve.session import Session
from spikeserve.stream_opener import StreamOpener
from spikeserve.values import Decision, ExecutedLike
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class _Call:
    """One call of ActStream. A thread reads its replies."""

    def __init__(self, open_stream: Callable[[Iterable[Message]], Any]) -> None:
        self._requests: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[Message | SpikeserveError] = queue.SimpleQueue()
        self._call = open_stream(iter(self._requests.get, None))
        self._ended = False  # by this client
        self._reader = threading.Thread(
            target=self._read, name="spikeserve-act-stream", daemon=True
        )
        self._reader.start()

    def send(self, request: Message) -> None:
        self._requests.put(request)

    def receive(self, timeout: float | None) -> Message | SpikeserveError | None:
        """Returns the next reply, the error that ended the call, or None after `timeout`."""
        try:
            return self._replies.get(timeout=timeout)
        except queue.Empty:
            return None

    def end(self) -> None:
        self._ended = True
        self._requests.put(None)
        self._call.cancel()
        self._reader.join()

    def _read(self) -> None:
        try:
            for reply in self._call:
                self._replies.put(reply)
            self._replies.put(stream_ended())
        except grpc.RpcError as error:
            # A proxy may cancel the streams of a server that has ended.
            is_cut = error.code() == grpc.StatusCode.CANCELLED and not self._ended
            self._replies.put(stream_ended() if is_cut else error_of_call("ActStream", error))


class ActStream:
    """A stream of decisions. Not thread-safe.

    A session has at most one request under way. Requests of different sessions do not wait for
    each other. If the connection breaks, `receive` opens another stream and sends the requests
    without an answer again, as long as `ClientOptions.retry` allows; then it raises
    UnavailableError, and the next `send` opens another stream. With RetryOptions(max_attempts=1) a
    broken stream stays broken. A request that the server refused for a moment is sent again at the
    time that the server named. With several servers, the next stream goes to another one, and so do
    all calls of the sessions of the stream.
    """

    def __init__(self, client: Connection) -> None:
        self._client = client
        self._opener = StreamOpener(client)
        self._open: OpenRequests[Session] = OpenRequests(
            self._opener, client.options, client.patience
        )
        self._closed = False
        self._reopens_at: float | None = None  # of time.monotonic(); None: the stream is whole
        self._call = _Call(self._opener.open)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def route(self) -> Route:
        """Returns the way of the calls of the stream, for Client.open_session."""
        return self._opener.route

    def send(
        self,
        session: Session,
        observation: ArrayLike,
        reward: float | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> None:
        """Sends a request for the decision at the step of `session`. Does not wait.

        The arguments are those of Session.act. UnavailableError if the stream is broken and the
        policy for retries allows no other one.
        """
        self._reopen_if_broken()
        self._call.send(self._open.add(session, observation, reward, executed_action))

    def receive(self, timeout: float | None = None) -> tuple[Session, Decision | SpikeserveError]:
        """Returns the next answer of any session: a decision, or the error of that request.

        Raises DeadlineExceededError if no answer came within `timeout` seconds. The stream stays
        open then.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            if self._open.broken is not None:
                raise self._open.broken
            reply = self._next_reply(deadline)
            if reply is None:
                if deadline is not None and time.monotonic() >= deadline:
                    message = f"no answer within {timeout} s"
                    raise make_error("ActStream", grpc.StatusCode.DEADLINE_EXCEEDED, message)
                continue
            if isinstance(reply, SpikeserveError):
                self._break(reply)
                continue
            accepted = self._open.accept(reply)
            if isinstance(accepted, SpikeserveError):
                self._break(accepted)
            elif isinstance(accepted, OpenRequest):
                answered = self._find(accepted)
                if answered is not None:
                    return answered
            elif accepted is not None:
                return accepted

    def _break(self, error: SpikeserveError) -> None:
        pause = self._open.pause_after_break(error)
        self._reopens_at = None if pause is None else time.monotonic() + pause

    def _find(
        self, request: OpenRequest[Session]
    ) -> tuple[Session, Decision | SpikeserveError] | None:
        """Makes the call of a request outside of the stream. None: in a new session, later."""
        session = request.session
        try:
            return session, self._client.run(request.call)
        except SessionLostError as error:
            if not session.reopens:
                return session, error
        except SpikeserveError as error:
            return session, error
        session.open_again()
        self._call.send(self._open.restart(request))
        return None

    def act(
        self,
        session: Session,
        observation: ArrayLike,
        reward: float | None = None,
        timeout: float | None = None,
        *,
        executed_action: ExecutedLike | None = None,
    ) -> Decision:
        """Sends and receives. ValueError if another request is under way."""
        self._open.check_empty()
        self.send(session, observation, reward, executed_action=executed_action)
        result = self.receive(timeout)[1]
        if isinstance(result, SpikeserveError):
            raise result
        return result

    def close(self) -> None:
        """Ends the stream. Drops answers that were not received."""
        self._closed = True
        self._call.end()

    def _next_reply(self, deadline: float | None) -> Message | SpikeserveError | None:
        """Returns the next reply, the error that ended the call, or None after some time."""
        if self._reopens_at is not None:
            now = time.monotonic()
            until = self._reopens_at if deadline is None else min(self._reopens_at, deadline)
            time.sleep(max(0.0, until - now))
            if until == self._reopens_at:
                self._start()
            return None
        for request in self._open.take_due():
            self._call.send(request)
        until_due = self._open.seconds_until_due()
        until_end = None if deadline is None else max(0.0, deadline - time.monotonic())
        until_silent = self._open.seconds_until_silent()
        until_doubt = self._open.seconds_until_doubt()
        waits = [s for s in (until_due, until_end, until_silent, until_doubt) if s is not None]
        reply = self._call.receive(min(waits) if waits else None)
        if reply is None:
            self._open.doubt()
        return stream_silent() if reply is None and self._open.is_silent() else reply

    def _reopen_if_broken(self) -> None:
        if self._closed:
            raise stream_closed()
        if self._open.broken is None:
            return
        if not self._open.may_reopen():
            raise self._open.broken
        self._start()

    def _start(self) -> None:
        self._call.end()
        self._call = _Call(self._opener.open)
        self._open.broken = None
        self._reopens_at = None
        for request in self._open.all_messages():
            self._call.send(request)
