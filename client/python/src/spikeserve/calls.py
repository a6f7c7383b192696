"""The calls of the service: the request that each one sends and the value of its response.

The blocking client and the asyncio client both run these descriptions (see connection.py). Nothing
in this module sends or waits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import grpc
from numpy.typing import ArrayLike

from spikeserve.check import check
from spikeserve.errors import (
    NotFoundError,
    SessionLostError,
    SpikeserveError,
    error_of_item,
    for_session,
    make_error,
    was_refused,
)
from spikeserve.explanation import Explanation
from spikeserve.values import (
    ActionLike,
    Decision,
    EpisodeSummary,
    Opening,
    Policy,
    SessionOptions,
    SessionState,
    action_to_wire,
    observation_array,
)
from spikeserve.wire import METHODS, Message

T = TypeVar("T")

# The executed action of each row; None: as answered. None in place of the list: all as answered.
ExecutedActions = Sequence[ActionLike | None] | None


@dataclass(frozen=True)
class Call(Generic[T]):
    """One unary call, whose value is a T. Every attempt sends the same request.

    `decode` turns the response into the value. It runs once, after the last attempt.
    """

    method: str
    request: Message
    decode: Callable[[Message], T]
    timeout: float | None = None  # seconds for each attempt; None: the timeout of the client
    # The error of a repeated attempt that means: an earlier attempt, whose response was lost, has
    # taken effect. None where the server answers a repeated request with the stored response.
    already_done: type[SpikeserveError] | None = None
    # Whether it is harmless to repeat the call when it is unknown if the server carried it out.
    repeatable: bool = True
    session_id: str = ""  # the session that the request names; "": none
    # Looks for items of the response that may be sent again; None: the call has no items.
    failed_items: Callable[[Message], FailedItems | None] | None = None


@dataclass(frozen=True)
class FailedItems:
    """The items of a batch that the server refused for now.

    `request` asks for them again, `merge` puts the items of its response into the first response,
    and `error` is the error of the item that needs the longest pause.
    """

    request: Message
    error: SpikeserveError
    merge: Callable[[Message], None]


def list_policies() -> Call[list[Policy]]:
    """Describes Client.list_policies."""
    request = METHODS["ListPolicies"].request()
    return Call("ListPolicies", request, lambda r: [Policy.from_wire(p) for p in r.policies])


def open_session(policy: str, options: SessionOptions | None) -> Call[tuple[str, Opening]]:
    """Describes Client.open_session. The value is the session id and the opening."""
    request = (options or SessionOptions()).to_wire(policy)
    return Call("OpenSession", request, lambda r: (r.session_id, Opening.from_wire(r)))


class SessionCursor:
    """The id of a session and the step of its next request. Describes the calls of a session."""

    def __init__(self, session_id: str, step: int) -> None:
        self.session_id = session_id
        self.step = step

    def act(
        self,
        observation: ArrayLike,
        reward: float | None,
        timeout: float | None = None,
        executed_action: ActionLike | None = None,
    ) -> Call[Decision]:
        """Describes Session.act. The response moves the cursor to the next step."""
        check(self.step == 0 or reward is not None, "reward", "one after step 0", None)
        request = METHODS["Act"].request(
            session_id=self.session_id,
            step=self.step,
            observation=observation_array(observation),
            reward=0.0 if self.step == 0 or reward is None else float(reward),
            executed_action=action_to_wire(executed_action),
        )
        return Call("Act", request, self.accept, timeout, session_id=self.session_id)

    def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
        executed_action: ActionLike | None = None,
    ) -> Call[EpisodeSummary]:
        """Describes Session.end_episode. The response moves the cursor to step 0."""
        request = METHODS["EndEpisode"].request(
            session_id=self.session_id,
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            target_return=target_return,
            observation=() if observation is None else observation_array(observation),
            executed_action=action_to_wire(executed_action),
        )
        return Call("EndEpisode", request, self._accept_end, session_id=self.session_id)

    def state(self, include_head_delta: bool = False) -> Call[SessionState]:
        """Describes Session.state."""
        request = METHODS["GetSession"].request(
            session_id=self.session_id, include_head_delta=include_head_delta
        )
        return Call("GetSession", request, SessionState.from_wire, session_id=self.session_id)

    def explain(self) -> Call[Explanation]:
        """Describes Session.explain."""
        request = METHODS["Explain"].request(session_id=self.session_id)
        return Call("Explain", request, Explanation.from_wire, session_id=self.session_id)

    def close(self) -> Call[None]:
        """Describes Session.close."""
        request = METHODS["CloseSession"].request(session_id=self.session_id)
        return Call(
            "CloseSession",
            request,
            lambda _: None,
            already_done=NotFoundError,
            session_id=self.session_id,
        )

    def check(self, response: Message) -> None:
        """Raises SpikeserveError (INTERNAL) if `response` does not answer this step."""
        if (response.session_id, response.step) != (self.session_id, self.step):
            raise make_error(
                "Act",
                grpc.StatusCode.INTERNAL,
                f"response: expected step {self.step} of session {self.session_id}, "
                f"received step {response.step} of session {response.session_id}",
            )

    def accept(self, response: Message) -> Decision:
        """Returns the decision of an ActResponse to this step and moves to the next step."""
        self.check(response)
        self.step += 1
        return Decision.from_wire(response)

    def _accept_end(self, response: Message) -> EpisodeSummary:
        self.step = 0
        return EpisodeSummary.from_wire(response)


def act_each(
    cursors: Sequence[SessionCursor],
    observations: Sequence[ArrayLike],
    rewards: Sequence[float],
    timeout: float | None,
    executed_actions: ExecutedActions = None,
) -> Call[list[Decision | SpikeserveError]]:
    """Describes Client.act_batch. A cursor whose result is a decision moves to its next step."""

    def accept(results: list[Any]) -> list[Decision | SpikeserveError]:
        return [
            result if isinstance(result, SpikeserveError) else cursor.accept(result)
            for cursor, result in zip(cursors, results, strict=True)
        ]

    return _act_batch(cursors, observations, rewards, timeout, accept, executed_actions)


def act_all(
    cursors: Sequence[SessionCursor],
    observations: Sequence[ArrayLike],
    rewards: Sequence[float],
    timeout: float | None,
    executed_actions: ExecutedActions = None,
) -> Call[list[Decision]]:
    """Describes an ActBatch that raises its first error. All cursors move, or none does."""

    def accept(results: list[Any]) -> list[Decision]:
        lost = [result for result in results if isinstance(result, SessionLostError)]
        if lost:
            lost[0].session_ids = [error.session_ids[0] for error in lost]
            raise lost[0]
        for cursor, result in zip(cursors, results, strict=True):
            if isinstance(result, SpikeserveError):
                raise result
            cursor.check(result)
        return [cursor.accept(result) for cursor, result in zip(cursors, results, strict=True)]

    return _act_batch(cursors, observations, rewards, timeout, accept, executed_actions)


def _act_batch(
    cursors: Sequence[SessionCursor],
    observations: Sequence[ArrayLike],
    rewards: Sequence[float],
    timeout: float | None,
    accept: Callable[[list[Any]], T],
    executed_actions: ExecutedActions,
) -> Call[T]:
    """`accept` receives an ActResponse or a SpikeserveError for each cursor."""
    executed = [None] * len(cursors) if executed_actions is None else executed_actions
    requests = [
        cursor.act(observation, reward, executed_action=action).request
        for cursor, observation, reward, action in zip(
            cursors, observations, rewards, executed, strict=True
        )
    ]

    def decode(response: Message) -> T:
        if len(response.results) != len(requests):
            raise make_error(
                "ActBatch",
                grpc.StatusCode.INTERNAL,
                f"results: expected {len(requests)} items, received {len(response.results)}",
            )
        return accept(
            [
                item.response
                if item.code == 0
                else for_session(_error_of(item), request.session_id)
                for request, item in zip(requests, response.results, strict=True)
            ]
        )

    request = METHODS["ActBatch"].request(requests=requests)
    return Call("ActBatch", request, decode, timeout, failed_items=_failed_items_of(requests))


def _error_of(item: Message) -> SpikeserveError:
    delay = item.retry_after_seconds if item.HasField("retry_after_seconds") else None
    return error_of_item("Act", item.code, item.message, delay)


def _failed_items_of(requests: list[Message]) -> Callable[[Message], FailedItems | None]:
    """Returns Call.failed_items of a batch of `requests`."""

    def find(response: Message) -> FailedItems | None:
        refused = {
            row: error
            for row, item in enumerate(response.results[: len(requests)])
            if item.code != 0 and was_refused(error := _error_of(item))
        }
        if not refused:
            return None

        def merge(part: Message) -> None:
            for row, item in zip(refused, part.results, strict=True):
                response.results[row].CopyFrom(item)

        request = METHODS["ActBatch"].request(requests=[requests[row] for row in refused])
        longest = max(refused.values(), key=lambda error: error.retry_after or 0.0)
        return FailedItems(request, longest, merge)

    return find
