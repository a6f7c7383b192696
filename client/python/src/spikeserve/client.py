"""The blocking client: `Client`, and `Session`, which keeps an agent's step."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import grpc
from numpy.typing import ArrayLike

from spikeserve.calls import (
    CHANNEL_OPTIONS,
    DEFAULT_SERVER,
    Attempts,
    ClientOptions,
    SessionCursor,
    batch_request,
    batch_results,
)
from spikeserve.errors import NotFoundError, SpikeserveError
from spikeserve.stream import ActStream
from spikeserve.values import (
    Decision,
    EpisodeSummary,
    Opening,
    Policy,
    SessionOptions,
    SessionState,
)
from spikeserve.wire import ACT_STREAM, METHODS, Message


class Client:
    """The calls of the server at "HOST:PORT". Thread-safe.

    The connection is made when the first call needs it and made again when it breaks. Calls raise
    SpikeserveError (spikeserve.errors) with the server's message; those that end with UNAVAILABLE
    or DEADLINE_EXCEEDED are repeated as `options.retry` says before they raise. `timeout`, where a
    call takes one, replaces that of the options.

    `credentials` are grpc's (grpc.ssl_channel_credentials and its kin); None: plain text.
    """

    def __init__(
        self,
        server: str = DEFAULT_SERVER,
        options: ClientOptions | None = None,
        credentials: grpc.ChannelCredentials | None = None,
    ) -> None:
        self._options = options or ClientOptions()
        if credentials is None:
            self._channel = grpc.insecure_channel(server, CHANNEL_OPTIONS)
        else:
            self._channel = grpc.secure_channel(server, credentials, CHANNEL_OPTIONS)
        self._calls = {name: method.bind(self._channel) for name, method in METHODS.items()}
        self._open_stream = ACT_STREAM.bind(self._channel)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection. The server keeps the sessions that were not closed."""
        self._channel.close()

    def list_policies(self) -> list[Policy]:
        """Every policy version that is served, by name, then version."""
        response = self.call("ListPolicies", METHODS["ListPolicies"].request())
        return [Policy.from_wire(policy) for policy in response.policies]

    def open_session(self, policy: str, options: SessionOptions | None = None) -> Session:
        """A new session of `policy`, at the start of its first episode."""
        response = self.call("OpenSession", (options or SessionOptions()).to_wire(policy))
        return Session(self, response.session_id, opening=Opening.from_wire(response))

    def act_batch(
        self,
        sessions: Sequence[Session],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
    ) -> list[Decision | SpikeserveError]:
        """One decision for each of many sessions, in one call.

        A session whose row is an error stays at its step; the others have moved on.
        """
        cursors = [session.cursor for session in sessions]
        results = self.act_batch_messages(cursors, observations, rewards, timeout)
        return [
            result if isinstance(result, SpikeserveError) else cursor.accept(result)
            for cursor, result in zip(cursors, results, strict=True)
        ]

    def act_batch_messages(
        self,
        cursors: Sequence[SessionCursor],
        observations: Sequence[ArrayLike],
        rewards: Sequence[float],
        timeout: float | None = None,
    ) -> list[Any]:
        """act_batch that leaves the sessions at their steps: ActResponses and errors."""
        request = batch_request(cursors, observations, rewards)
        return batch_results(self.call("ActBatch", request, timeout), len(cursors))

    def act_stream(self) -> ActStream:
        """A stream of decisions for any number of sessions."""
        return ActStream(self._open_stream)

    def call(
        self,
        name: str,
        request: Message,
        timeout: float | None = None,
        repeated: type[SpikeserveError] | None = None,
    ) -> Message:
        """The answer to any unary method of the service, with retries.

        None if an attempt raised `repeated` after one whose answer was lost.
        """
        attempts = Attempts(name, self._options.retry, repeated)
        deadline = self._options.timeout if timeout is None else timeout
        while True:
            try:
                return self._calls[name](request, timeout=deadline, metadata=self._options.metadata)
            except grpc.RpcError as error:
                pause = attempts.pause_after(error)
            if pause is None:
                return None
            time.sleep(pause)


class Session:
    """One agent's session. Not thread-safe; many may share a client.

    It is a pair of session id and step, nothing more: an agent that was restarted attaches to its
    old session with Session(client, session_id, step). The last answered step may be asked again
    and gets that answer again.
    """

    def __init__(
        self, client: Client, session_id: str, step: int = 0, opening: Opening | None = None
    ) -> None:
        self._client = client
        self.cursor = SessionCursor(session_id, step)
        self.opening = opening

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exception_type: type[BaseException] | None,
        exception: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except SpikeserveError:
            if exception is None:  # otherwise what went wrong first matters more
                raise

    @property
    def session_id(self) -> str:
        """The server's name of the session."""
        return self.cursor.session_id

    @property
    def step(self) -> int:
        """The step of the next request."""
        return self.cursor.step

    def act(
        self, observation: ArrayLike, reward: float = 0.0, timeout: float | None = None
    ) -> Decision:
        """The decision at this step.

        `observation` in raw environment units; `reward` for the previous action, ignored at step
        0. The step moves on only with an answer: after an error the same call may be made again.
        """
        request = self.cursor.act_request(observation, reward)
        return self.cursor.accept(self._client.call("Act", request, timeout))

    def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
    ) -> EpisodeSummary:
        """Hands in the last reward; the next step is step 0.

        `target_return` is for the next episode; None: the session's own. `observation` is what the
        last action led to; only recordings have a use for it. Repeated safely: an end counts once,
        and the server answers it again.
        """
        request = self.cursor.end_request(reward, terminated, truncated, target_return, observation)
        return self.cursor.end(self._client.call("EndEpisode", request))

    def state(self) -> SessionState:
        """The server's view of the session."""
        request = METHODS["GetSession"].request(session_id=self.session_id)
        return SessionState.from_wire(self._client.call("GetSession", request))

    def close(self) -> None:
        """Ends the session on the server."""
        request = METHODS["CloseSession"].request(session_id=self.session_id)
        self._client.call("CloseSession", request, repeated=NotFoundError)
