"""The part of a session that the blocking and the asyncio client share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from spikeserve.caller import Caller
from spikeserve.calls import Call, Opened
from spikeserve.check import check
from spikeserve.cursor import SessionCursor
from spikeserve.values import Opening

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

AnyConnection = TypeVar("AnyConnection", bound=Caller)


class SessionHandle(Generic[AnyConnection]):
    """Refers to a session on the server by id and step. Sends nothing by itself."""

    def __init__(
        self,
        client: AnyConnection,
        session_id: str,
        step: int = 0,
        opening: Opening | None = None,
    ) -> None:
        self._client = client
        self.cursor = SessionCursor(session_id, step)
        self.opening = opening
        self._new_opening: Callable[[], Call[Opened]] | None = None
        self._closed = False
        self.reopened = 0  # how often a lost session was replaced by a new one

    @classmethod
    def _of(
        cls,
        client: AnyConnection,
        opened: Opened,
        open_again: Callable[[], Call[Opened]] | None,
    ) -> Self:
        """Returns a session that was opened now. `open_again` describes how to open another one."""
        session = cls(client, opened.session_id)
        session._new_opening = open_again
        session._begin(opened)
        return session

    @property
    def reopens(self) -> bool:
        """Returns whether a lost session is replaced by a new one."""
        return self._new_opening is not None

    def _begin(self, opened: Opened) -> None:
        """Continues with a new session, at step 0 of its first episode."""
        self.cursor.begin(opened, self.reopens)
        self.opening = opened.opening

    async def _open_again(self) -> None:
        """Replaces a lost session by a new one."""
        opening = self._new_opening
        check(opening is not None, "session", "one opened with reopen=True", "another")
        assert opening is not None
        self._begin(await self._client.perform(opening()))
        self.reopened += 1

    @property
    def session_id(self) -> str:
        """Returns the id of the session."""
        return self.cursor.session_id

    @property
    def step(self) -> int:
        """Returns the step of the next request."""
        return self.cursor.step


AnySession = TypeVar("AnySession", bound=SessionHandle[Any])
