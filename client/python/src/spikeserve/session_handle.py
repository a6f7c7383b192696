"""The part of a session that the blocking and the asyncio client share."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from spikeserve.calls import Call, SessionCursor
from spikeserve.values import Opening

AnyConnection = TypeVar("AnyConnection")


class SessionHandle(Generic[AnyConnection]):
    """Refers to a session on the server by id and step. Sends nothing by itself."""

    def __init__(
        self,
        client: AnyConnection,
        session_id: str,
        step: int = 0,
        opening: Opening | None = None,
        reopening: Call[tuple[str, Opening]] | None = None,
    ) -> None:
        self._client = client
        self.cursor = SessionCursor(session_id, step)
        self.opening = opening
        self._reopening = reopening
        self.reopened = 0  # how often a lost session was replaced by a new one

    @property
    def reopens(self) -> bool:
        """Returns whether a lost session is replaced by a new one."""
        return self._reopening is not None

    def _move_to(self, opened: tuple[str, Opening]) -> None:
        """Continues with a new session, at step 0 of its first episode."""
        self.cursor.session_id, self.opening = opened
        self.cursor.step = 0
        self.reopened += 1

    @property
    def session_id(self) -> str:
        """Returns the id that the server gave to the session."""
        return self.cursor.session_id

    @property
    def step(self) -> int:
        """Returns the step of the next request."""
        return self.cursor.step


AnySession = TypeVar("AnySession", bound=SessionHandle[Any])
