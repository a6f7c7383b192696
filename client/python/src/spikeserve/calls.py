"""What the blocking and the asyncio client share: settings, requests, and what a failure means.

Nothing here waits or sends.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import grpc
from numpy.typing import ArrayLike

from spikeserve.errors import (
    SpikeserveError,
    error_of_call,
    error_of_item,
    is_retryable,
    make_error,
)
from spikeserve.retry import RetryOptions
from spikeserve.values import Decision, EpisodeSummary, observation_array
from spikeserve.wire import METHODS, Message, message_class

# As the C++ client: a connection of its own, and a server that was restarted is found again within
# a second, not gRPC's two minutes.
CHANNEL_OPTIONS = [
    ("grpc.use_local_subchannel_pool", 1),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1000),
]

DEFAULT_SERVER = "127.0.0.1:50051"


@dataclass(frozen=True)
class ClientOptions:
    """How calls are made. `timeout` is the deadline of each attempt, in seconds.

    `token` is sent with every call; it defaults to the environment variable SPIKESERVE_TOKEN.
    """

    timeout: float = 5.0
    retry: RetryOptions = field(default_factory=RetryOptions)
    token: str = field(default_factory=lambda: os.environ.get("SPIKESERVE_TOKEN", ""), repr=False)

    def __post_init__(self) -> None:
        if not self.timeout > 0:
            raise ValueError(f"timeout: expected more than 0, got {self.timeout}")

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """What every call carries beside its request."""
        return (("authorization", f"Bearer {self.token}"),) if self.token else ()


class Attempts:
    """The attempts of one call. `repeated` is what a repeated attempt raises if an earlier one,
    whose answer was lost, was carried out; None where the server repeats its answer.
    """

    def __init__(
        self, call: str, retry: RetryOptions, repeated: type[SpikeserveError] | None
    ) -> None:
        self._call = call
        self._pauses = retry.pauses()
        self._repeated = repeated
        self._failed = 0

    def pause_after(self, rpc_error: grpc.RpcError) -> float | None:
        """Seconds to wait before the next attempt; None if an earlier one was carried out.

        Raises the error if there is no next attempt.
        """
        error = error_of_call(self._call, rpc_error)
        self._failed += 1
        if self._repeated is not None and self._failed > 1 and isinstance(error, self._repeated):
            return None
        pause = next(self._pauses, None) if is_retryable(error) else None
        if pause is None:
            raise error from rpc_error
        return pause


class SessionCursor:
    """Where a session stands: its id and the step of the next request."""

    def __init__(self, session_id: str, step: int) -> None:
        self.session_id = session_id
        self.step = step

    def act_request(self, observation: ArrayLike, reward: float) -> Message:
        """The request of this step, the same for every attempt."""
        return message_class("ActRequest")(
            session_id=self.session_id,
            step=self.step,
            observation=observation_array(observation),
            reward=float(reward) if self.step > 0 else 0.0,
        )

    def check(self, message: Message) -> None:
        """Raises if `message` is not the answer to this step."""
        if (message.session_id, message.step) != (self.session_id, self.step):
            raise make_error(
                "Act",
                grpc.StatusCode.INTERNAL,
                f"expected the answer to step {self.step} of session {self.session_id}, "
                f"got that to step {message.step} of session {message.session_id}",
            )

    def accept(self, message: Message) -> Decision:
        """Moves on to the next step with the answer to this one."""
        self.check(message)
        self.step += 1
        return Decision.from_wire(message)

    def end_request(
        self,
        reward: float,
        terminated: bool,
        truncated: bool,
        target_return: float | None,
        observation: ArrayLike | None,
    ) -> Message:
        """The request that ends this episode."""
        return message_class("EndEpisodeRequest")(
            session_id=self.session_id,
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            target_return=target_return,
            observation=() if observation is None else observation_array(observation),
        )

    def end(self, message: Message) -> EpisodeSummary:
        """Moves on to the next episode with the answer to the end of this one."""
        self.step = 0
        return EpisodeSummary.from_wire(message)


def batch_request(
    cursors: Sequence[SessionCursor], observations: Sequence[ArrayLike], rewards: Sequence[float]
) -> Message:
    """One decision for each of many sessions."""
    rows = zip(cursors, observations, rewards, strict=True)
    return METHODS["ActBatch"].request(
        requests=[cursor.act_request(observation, reward) for cursor, observation, reward in rows]
    )


def batch_results(message: Message, expected: int) -> list[Any]:
    """An ActResponse or a SpikeserveError for each item, in the order of the requests."""
    if len(message.results) != expected:
        raise make_error(
            "ActBatch",
            grpc.StatusCode.INTERNAL,
            f"results: expected {expected} of them, got {len(message.results)}",
        )
    return [
        result.response if result.code == 0 else error_of_item("Act", result.code, result.message)
        for result in message.results
    ]


class HasCursor(Protocol):
    """A session of either client."""

    cursor: SessionCursor


AnySession = TypeVar("AnySession", bound=HasCursor)


class OpenRequests(Generic[AnySession]):
    """The sessions that have a request under way on a stream, one each."""

    def __init__(self) -> None:
        self._sessions: dict[str, AnySession] = {}

    def add(self, session: AnySession, observation: ArrayLike, reward: float) -> Message:
        """The request to send."""
        cursor = session.cursor
        if cursor.session_id in self._sessions:
            raise ValueError(f"session {cursor.session_id}: expected no request under way, got one")
        request = cursor.act_request(observation, reward)
        self._sessions[cursor.session_id] = session
        return request

    def check_empty(self) -> None:
        """ValueError if a request is under way."""
        if self._sessions:
            raise ValueError(f"expected no request under way, got {len(self._sessions)}")

    def accept(self, reply: Message) -> tuple[AnySession, Decision | SpikeserveError]:
        """Whose answer it is; the session moves on with it, but not with an error."""
        session = self._sessions.pop(reply.session_id, None)
        if session is None:
            raise make_error(
                "ActStream",
                grpc.StatusCode.INTERNAL,
                f"expected an answer to a request under way, got one for {reply.session_id}",
            )
        if reply.HasField("error"):
            return session, error_of_item("ActStream", reply.error.code, reply.error.message)
        return session, session.cursor.accept(reply)


def stream_ended() -> SpikeserveError:
    """What a stream raises that the server ended."""
    return make_error("ActStream", grpc.StatusCode.UNAVAILABLE, "the server ended the stream")
