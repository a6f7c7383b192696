"""`ActStream`: the decisions of any number of sessions on one blocking stream."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import grpc
from numpy.typing import ArrayLike

from spikeserve.calls import OpenRequests, stream_ended
from spikeserve.errors import SpikeserveError, error_of_call, make_error
from spikeserve.values import Decision
from spikeserve.wire import Message

if TYPE_CHECKING:
    from spikeserve.client import Session


class ActStream:
    """One ActStream call. Not thread-safe.

    A session has at most one request under way; requests of different sessions need not wait for
    each other. Nothing is repeated by itself: if the stream breaks, `receive` raises, and what was
    not answered may be sent again on another stream, or asked with `Session.act`.
    """

    def __init__(self, open_stream: Callable[[Iterable[Message]], Any]) -> None:
        self._requests: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._replies: queue.SimpleQueue[Message | SpikeserveError] = queue.SimpleQueue()
        self._open: OpenRequests[Session] = OpenRequests()
        self._call = open_stream(iter(self._requests.get, None))
        self._reader = threading.Thread(
            target=self._read, name="spikeserve-act-stream", daemon=True
        )
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def send(self, session: Session, observation: ArrayLike, reward: float = 0.0) -> None:
        """Asks for the decision at the session's step; never waits."""
        self._requests.put(self._open.add(session, observation, reward))

    def receive(self, timeout: float | None = None) -> tuple[Session, Decision | SpikeserveError]:
        """The next answer of any session, which has then moved on unless it is an error.

        DeadlineExceededError if none came within `timeout` seconds (the stream goes on).
        """
        try:
            reply = self._replies.get(timeout=timeout)
        except queue.Empty:
            raise make_error(
                "ActStream", grpc.StatusCode.DEADLINE_EXCEEDED, f"no answer within {timeout} s"
            ) from None
        if isinstance(reply, SpikeserveError):
            self._replies.put(reply)  # whoever asks again hears it again
            raise reply
        return self._open.accept(reply)

    def act(
        self,
        session: Session,
        observation: ArrayLike,
        reward: float = 0.0,
        timeout: float | None = None,
    ) -> Decision:
        """`send` and `receive` where no other session's request is under way."""
        self._open.check_empty()
        self.send(session, observation, reward)
        result = self.receive(timeout)[1]
        if isinstance(result, SpikeserveError):
            raise result
        return result

    def close(self) -> None:
        """Ends the stream; answers that were not received are dropped."""
        self._requests.put(None)
        self._call.cancel()
        self._reader.join()

    def _read(self) -> None:
        try:
            for reply in self._call:
                self._replies.put(reply)
            self._replies.put(stream_ended())
        except grpc.RpcError as error:
            self._replies.put(error_of_call("ActStream", error))
