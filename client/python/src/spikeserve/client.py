"""`Client`: the blocking client."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from numpy.typing import ArrayLike

from spikeserve.batches import ExecutedActions, act_each, by_server
from spikeserve.calls import list_policies, named, open_session
from spikeserve.connection import Connection
from spikeserve.errors import SpikeserveError
from spikeserve.replicas import Route
from spikeserve.session import Session
from spikeserve.stream import ActStream
from spikeserve.values import Decision, Policy, SessionOptions


class Client(Connection):
    """The calls of the server at `server`, "HOST:PORT" or "unix:PATH". Thread-safe.

    Without `server`, the environment variable SPIKESERVE_SERVER or else 127.0.0.1:50051. Several
    addresses, separated by commas, are those of servers that share their sessions in one store
    (docs/guides/fleet.md): each session prefers one of them, and goes to another one while that one
    does not answer.

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
        self,
        policy: str,
        options: SessionOptions | None = None,
        *,
        observation: Sequence[str] = (),
        action: Sequence[str] = (),
        reopen: bool = False,
        route: Route | None = None,
    ) -> Session:
        """Opens a session of `policy` at step 0 of its first episode.

        `observation` and `action` are the names of the robot's elements in its own order, as in
        SessionOptions. InvalidArgumentError names the first one that the policy does not have.

        With `reopen`, a session that the server has lost is replaced by a new one with the same
        options. Without it, its calls raise SessionLostError. With several servers, sessions with
        the same `route` go to the same server, for example those of a vector environment.
        """
        open_again = functools.partial(
            open_session, policy, named(options, observation, action), route
        )
        return Session._of(self, self.run(open_again()), open_again if reopen else None)

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
        others move to their next step. With several servers, there is one call for each of them
        that has some of the sessions, which stay together from then on.
        """
        cursors = [session.cursor for session in sessions]
        executed = [None] * len(cursors) if executed_actions is None else executed_actions
        results: dict[int, Decision | SpikeserveError] = {}
        for rows in by_server(cursors, self.replicas):
            batch = act_each(
                [cursors[row] for row in rows],
                [observations[row] for row in rows],
                [rewards[row] for row in rows],
                timeout,
                [executed[row] for row in rows],
            )
            answers = self.run(batch)
            results.update(zip(rows, answers, strict=True))
        return [results[row] for row in range(len(cursors))]

    def act_stream(self) -> ActStream:
        """Opens a stream of decisions for any number of sessions."""
        return ActStream(self)
