"""`Session`: the session of one agent, blocking."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spikeserve.async_session import AsyncSession
from spikeserve.connection import Connection
from spikeserve.coroutines import blocking
from spikeserve.session_handle import SessionHandle

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on


class Session(SessionHandle[Connection]):
    """The session of one agent. Not thread-safe. Many sessions may share one client.

    A session is a session id and a step. A restarted agent attaches to its old session with
    Session(client, session_id, step). A request for the last answered step returns the stored
    answer of that step. `opening` is None for an attached session.

    A session that is stored (`opening.durability` is not NONE) outlives its server. The client
    keeps the requests that the store may not have yet, and sends them again to the server that goes
    on with the session. DivergedError if one of them gets another answer than before.
    """

    def __enter__(self) -> Self:
        return self

    __exit__ = blocking(AsyncSession.__aexit__)
    act = blocking(AsyncSession.act)
    end_episode = blocking(AsyncSession.end_episode)
    state = blocking(AsyncSession.state)
    explain = blocking(AsyncSession.explain)
    open_again = blocking(AsyncSession.open_again)
    close = blocking(AsyncSession.close)
