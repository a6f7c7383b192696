"""ActBatch: one decision for each of many sessions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import grpc
from numpy.typing import ArrayLike

from spikeserve.calls import Call, FailedItems, error_of_result
from spikeserve.cursor import SessionCursor
from spikeserve.errors import (
    SessionLostError,
    SpikeserveError,
    for_session,
    is_retryable,
    lost_session,
    make_error,
    was_refused,
)
from spikeserve.replicas import Replicas, Route
from spikeserve.values import Decision, ExecutedLike
from spikeserve.wire import METHODS, Message

T = TypeVar("T")

# The executed action of each row; None: as answered. None in place of the list: all as answered.
ExecutedActions = Sequence[ExecutedLike | None] | None


def by_server(cursors: Sequence[SessionCursor], replicas: Replicas) -> list[list[int]]:
    """Returns the rows of each server that has some of the sessions, one batch for each.

    The sessions of a batch follow its first one from now on, so that they stay together.
    """
    rows: dict[int, list[int]] = {}
    for row, cursor in enumerate(cursors):
        rows.setdefault(id(replicas.choose(cursor.route)), []).append(row)
    for group in rows.values():
        for row in group:
            cursors[row].route = cursors[group[0]].route
    return list(rows.values())


def act_each(
    cursors: Sequence[SessionCursor],
    observations: Sequence[ArrayLike],
    rewards: Sequence[float],
    timeout: float | None,
    executed_actions: ExecutedActions = None,
) -> Call[list[Decision | SpikeserveError]]:
    """Describes Client.act_batch. A cursor whose result is a decision moves to its next step."""

    def accept(requests: list[Message], results: list[Any]) -> list[Decision | SpikeserveError]:
        return [
            result if isinstance(result, SpikeserveError) else cursor.accept(request, result)
            for cursor, request, result in zip(cursors, requests, results, strict=True)
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

    def accept(requests: list[Message], results: list[Any]) -> list[Decision]:
        lost = [result for result in results if isinstance(result, SessionLostError)]
        if lost:
            lost[0].session_ids = [error.session_ids[0] for error in lost]
            raise lost[0]
        for cursor, result in zip(cursors, results, strict=True):
            if isinstance(result, SpikeserveError):
                raise result
            cursor.check(result)
        return [
            cursor.accept(request, result)
            for cursor, request, result in zip(cursors, requests, results, strict=True)
        ]

    return _act_batch(cursors, observations, rewards, timeout, accept, executed_actions)


def _act_batch(
    cursors: Sequence[SessionCursor],
    observations: Sequence[ArrayLike],
    rewards: Sequence[float],
    timeout: float | None,
    accept: Callable[[list[Message], list[Any]], T],
    executed_actions: ExecutedActions,
) -> Call[T]:
    """`accept` receives the requests, and an ActResponse or a SpikeserveError for each of them."""
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
        results = [
            item.response
            if item.code == 0
            else for_session(error_of_result(item), request.session_id)
            for request, item in zip(requests, response.results, strict=True)
        ]
        return accept(requests, results)

    return Call(
        "ActBatch",
        METHODS["ActBatch"].request(requests=requests),
        decode,
        timeout,
        route=cursors[0].route if cursors else Route(),
        failed_items=_failed_items_of(cursors, requests),
    )


def _failed_items_of(
    cursors: Sequence[SessionCursor], requests: list[Message]
) -> Callable[[Message], FailedItems | None]:
    """Returns Call.failed_items of a batch of `requests`."""

    def find(response: Message) -> FailedItems | None:
        failed: dict[int, SpikeserveError] = {}
        missing: list[Call[None]] = []
        for row, item in enumerate(response.results[: len(requests)]):
            if item.code == 0:
                continue
            error = for_session(error_of_result(item), requests[row].session_id)
            calls = cursors[row].missing(error)
            # Another server may have a lost session.
            if cursors[row].is_outdated(error):
                error = lost_session(error, requests[row].session_id)
            is_lost = isinstance(error, SessionLostError)
            if calls or is_lost or is_retryable(error) or was_refused(error):
                failed[row] = error
                missing += calls
        if not failed:
            return None

        def merge(part: Message) -> None:
            for row, item in zip(failed, part.results, strict=True):
                response.results[row].CopyFrom(item)

        request = METHODS["ActBatch"].request(requests=[requests[row] for row in failed])
        lost = [error for error in failed.values() if isinstance(error, SessionLostError)]
        others = [error for error in failed.values() if not isinstance(error, SessionLostError)]
        longest = max(others or lost, key=lambda error: error.retry_after or 0.0)
        if not others:
            lost[0].session_ids = [error.session_ids[0] for error in lost]
        return FailedItems(request, longest, merge, missing)

    return find
