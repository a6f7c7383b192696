"""The part of a stream that the blocking and the asyncio client share."""

from __future__ import annotations

from typing import Generic

import grpc
from numpy.typing import ArrayLike

from spikeserve.check import check
from spikeserve.errors import SpikeserveError, error_of_item, make_error
from spikeserve.session_handle import AnySession
from spikeserve.values import ActionLike, Decision
from spikeserve.wire import Message


class OpenRequests(Generic[AnySession]):
    """The sessions that wait for an answer on a stream, with one open request each."""

    def __init__(self) -> None:
        self._sessions: dict[str, AnySession] = {}

    def add(
        self,
        session: AnySession,
        observation: ArrayLike,
        reward: float,
        executed_action: ActionLike | None,
    ) -> Message:
        """Returns the request to send. ValueError if the session has an open request already."""
        session_id = session.session_id
        is_idle = session_id not in self._sessions
        check(is_idle, f"session {session_id}", "no request under way", "one")
        request = session.cursor.act(observation, reward, None, executed_action).request
        self._sessions[session_id] = session
        return request

    def check_empty(self) -> None:
        """ValueError if any session has an open request."""
        check(not self._sessions, "stream", "no request under way", len(self._sessions))

    def accept(self, reply: Message) -> tuple[AnySession, Decision | SpikeserveError]:
        """Returns the session that `reply` is for, and its decision or error.

        A decision moves the session to its next step. An error does not.
        """
        session = self._sessions.pop(reply.session_id, None)
        if session is None:
            raise make_error(
                "ActStream",
                grpc.StatusCode.INTERNAL,
                f"session_id: expected one with a request under way, received {reply.session_id}",
            )
        if reply.HasField("error"):
            return session, error_of_item("ActStream", reply.error.code, reply.error.message)
        return session, session.cursor.accept(reply)


def stream_ended() -> SpikeserveError:
    """Returns the error for a stream that the server has ended."""
    return make_error("ActStream", grpc.StatusCode.UNAVAILABLE, "the server ended the stream")
