"""`StreamOpener`: opens the calls of one stream."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from spikeserve.channels import Channels
from spikeserve.check import check
from spikeserve.cursor import SessionCursor
from spikeserve.replicas import Replica, Route, draw_id
from spikeserve.wire import ACT_STREAM, Message


class StreamOpener:
    """Opens the calls of one stream: at another server if the first one is gone."""

    def __init__(self, channels: Channels) -> None:
        self._channels = channels
        self.route = Route(draw_id())
        self.route.has_stream = True
        self._replica = channels.replicas.choose(self.route)
        self._line = self._replica.line

    def open(self, *requests: Iterable[Message], at: Replica | None = None) -> Any:
        """Opens a call at the preferred server, or `at` another one."""
        self._replica = at or self._channels.replicas.choose(self.route)
        metadata = self._channels.metadata(self.route)
        self._line = self._replica.line
        call = self._line.methods[ACT_STREAM.name](*requests, metadata=metadata)
        self._replica.streams.add(call)
        return call

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
        self._replica.doubt.answered()
        self._channels.replicas.answered(self.route, self._replica)

    def failed(self) -> None:
        """Notes that the server ended the call, or did not answer for the timeout of a call."""
        self._channels.replicas.failed(self._replica)

    def suspect(self, since: float) -> None:
        """Notes that a request has waited for its answer since `since` (time.monotonic())."""
        self._channels.suspect(self._replica, since)

    @property
    def is_renewed(self) -> bool:
        """Returns whether a fresh line has replaced that of the call, which was cancelled."""
        return self._line is not self._replica.line

    @property
    def has_others(self) -> bool:
        """Returns whether the stream may go to another server."""
        return self._channels.replicas.may_move(self.route)
