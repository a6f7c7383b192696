"""`Client`: the blocking client."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from spikeserve.calls import ExecutedActions, act_each, list_policies, open_session
from spikeserve.connection import Connection
from spikeserve.errors import SpikeserveError
from spikeserve.session import Session
from spikeserve.stream import ActStream
from spikeserve.values import Decision, Policy, SessionOptions


class Client(Connection):
    """The calls of the server at `server`, "HOST:PORT". Thread-safe.

    Without `server`, the environment variable SPIKESERVE_SERVER or else 127.0.0.1:50051.

    The first call connects, and a call after a broken connection connects again. A call that fails
    raises SpikeserveError (spikeserve.errors) with the message of the server. Before that, a call
    that ends with UNAVAILABLE or DEADLINE_EXCEEDED, or that the server refused for a moment, is
    repeated as `options.retry` defines. The argument `timeout` of a call bounds all its attempts
    and pauses together, in seconds; without it, `options.timeout` bounds each attempt.

    `credentials` are those of grpc, for example grpc.ssl_channel_credentials(); None: plain text.
    """

    def list_policies(self) -> list[Policy]:
        """Returns every policy version that is served, sorted by name, then by version."""
        return self.run(list_policies())

    def open_session(
        self, policy: str, options: SessionOptions | None = None, *, reopen: bool = False
    ) -> Session:
        """Opens a session of `policy` at step 0 of its first episode.

        With `reopen`, a session that the server has lost is replaced by a new one with the same
        options. Without it, its calls raise SessionLostError.
        """
        opening = open_session(policy, options)
        session_id, opened = self.run(opening)
        return Session(self, session_id, opening=opened, reopening=opening if reopen else None)

    def act_batch(
        self,
        sessions: Sequence[Session],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
        *,
        executed_actions: ExecutedActions = None,
    ) -> list[Decision | SpikeserveError]:
        """Returns one decision or error for each session, with a single call.

        `executed_actions` has the executed action of each session's previous step, or None for a
        session that executed the answer. A session whose result is an error stays at its step. The
        others move to their next step.
        """
        cursors = [session.cursor for session in sessions]
        return self.run(act_each(cursors, observations, rewards, timeout, executed_actions))

    def act_stream(self) -> ActStream:
        """Opens a stream of decisions for any number of sessions."""
        return ActStream(self._open_stream, self._options.retry, self._patience)
