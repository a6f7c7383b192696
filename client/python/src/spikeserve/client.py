"""`Client`: the blocking client."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from spikeserve.async_client import AsyncClient
from spikeserve.calls import named, open_session
from spikeserve.connection import Connection
from spikeserve.coroutines import blocking
from spikeserve.replicas import Route
from spikeserve.session import Session
from spikeserve.stream import ActStream
from spikeserve.values import SessionOptions


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

    list_policies = blocking(AsyncClient.list_policies)
    act_batch = blocking(AsyncClient.act_batch)
    amend_episode = blocking(AsyncClient.amend_episode)

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

    def act_stream(self) -> ActStream:
        """Opens a stream of decisions for any number of sessions."""
        return ActStream(self)
