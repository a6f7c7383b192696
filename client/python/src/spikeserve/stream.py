"""`ActStream`: the decisions of any number of sessions on one blocking stream."""

from __future__ import annotations

import queue
import time
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from spikeserve.connection import Connection
from spikeserve.coroutines import blocking, finish
from spikeserve.errors import SpikeserveError
from spikeserve.open_requests import stream_silent
from spikeserve.session import Session
from spikeserve.stream_call import StreamCall
from spikeserve.stream_core import StreamCore
from spikeserve.values import Decision, ExecutedLike
from spikeserve.wire import Message

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class ActStream(StreamCore[Session]):
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
        super().__init__(client)
        self._start_call()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    send = blocking(StreamCore[Session]._send)

    def receive(self, timeout: float | None = None) -> tuple[Session, Decision | SpikeserveError]:
        """Returns the next answer of any session: a decision, or the error of that request.

        Raises DeadlineExceededError if no answer came within `timeout` seconds. The stream stays
        open then.
        """
        return finish(self._receive(timeout))

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
        return finish(self._act(session, observation, reward, executed_action, timeout))

    def close(self) -> None:
        """Ends the stream. Drops answers that were not received."""
        self._closed = True
        self._call.end()

    async def _write(self, request: Message) -> None:
        self._call.send(request)

    async def _break(self, error: SpikeserveError) -> None:
        pause = self._open.pause_after_break(error)
        self._reopens_at = None if pause is None else time.monotonic() + pause

    async def _next_reply(self, deadline: float | None) -> Message | SpikeserveError | None:
        if self._reopens_at is not None:
            now = time.monotonic()
            until = self._reopens_at if deadline is None else min(self._reopens_at, deadline)
            time.sleep(max(0.0, until - now))
            if until == self._reopens_at:
                await self._start()
            return None
        for request in self._open.take_due():
            self._call.send(request)
        until_due = self._open.seconds_until_due()
        until_end = None if deadline is None else max(0.0, deadline - time.monotonic())
        until_silent = self._open.seconds_until_silent()
        until_doubt = self._open.seconds_until_doubt()
        waits = [s for s in (until_due, until_end, until_silent, until_doubt) if s is not None]
        try:
            return self._replies.get(timeout=min(waits) if waits else None)
        except queue.Empty:
            self._open.doubt()
            return stream_silent() if self._open.is_silent() else None

    def _open_call(self) -> None:
        self._call.end()
        self._start_call()

    def _start_call(self) -> None:
        # The replies of the call, and the error that ended it.
        replies: queue.SimpleQueue[Message | SpikeserveError] = queue.SimpleQueue()
        call = StreamCall(
            self._opener.open, lambda _, reply: replies.put(reply), lambda _, e: replies.put(e)
        )
        call.start()
        self._call, self._replies = call, replies
        self._reopens_at = None  # of time.monotonic(); None: the stream is whole
