"""`ActStream`: the decisions of any number of sessions on one blocking stream."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from typing import Any, Self

import grpc
from numpy.typing import ArrayLike

from spikeserve.errors import SpikeserveError, error_of_call, make_error
from spikeserve.open_requests import OpenRequests, stream_ended
from spikeserve.session import Session
from spikeserve.values import ActionLike, Decision
from spikeserve.wire import Message


class ActStream:
    """One ActStream call. Not thread-safe.

    A session has at most one request under way. Requests of different sessions do not wait for each
    other. The stream repeats nothing. If the stream breaks, `receive` raises, and requests without
    an answer may be sent again on another stream or with Session.act.
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

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(
        self,
        session: Session,
        observation: ArrayLike,
        reward: float = 0.0,
        *,
        executed_action: ActionLike | None = None,
    ) -> None:
        """Sends a request for the decision at the step of `session`. Does not wait.

        The arguments are those of Session.act.
        """
        self._requests.put(self._open.add(session, observation, reward, executed_action))

    def receive(self, timeout: float | None = None) -> tuple[Session, Decision | SpikeserveError]:
        """Returns the next answer of any session: a decision, or the error of that request.

        Raises DeadlineExceededError if no answer came within `timeout` seconds. The stream stays
        open then.
        """
        try:
            reply = self._replies.get(timeout=timeout)
        except queue.Empty:
            raise make_error(
                "ActStream", grpc.StatusCode.DEADLINE_EXCEEDED, f"no answer within {timeout} s"
            ) from None
        if isinstance(reply, SpikeserveError):
            self._replies.put(reply)  # the next `receive` raises the same error
            raise reply
        return self._open.accept(reply)

    def act(
        self,
        session: Session,
        observation: ArrayLike,
        reward: float = 0.0,
        timeout: float | None = None,
        *,
        executed_action: ActionLike | None = None,
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
