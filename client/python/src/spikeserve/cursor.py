"""`SessionCursor`: where a session is, and the calls from there."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import grpc
from numpy.typing import ArrayLike

from spikeserve.calls import Call, Opened
from spikeserve.check import check
from spikeserve.errors import NotFoundError, SpikeserveError, expected_decision, make_error
from spikeserve.executed import source_to_wire
from spikeserve.explanation import Explanation
from spikeserve.feature_order import FeatureOrder
from spikeserve.replicas import Route
from spikeserve.trace_context import active_traceparent
from spikeserve.unacknowledged import Unacknowledged
from spikeserve.values import (
    Decision,
    EpisodeSummary,
    ExecutedLike,
    SessionState,
    action_to_wire,
    observation_array,
)
from spikeserve.wire import METHODS, Message

T = TypeVar("T")


class SessionCursor:
    """The id of a session and the step of its next request. Describes the calls of a session.

    `decision` and `episode` are known for a session that this client opened, not for one that it
    attached to. Such a session is followed through the loss of its server.
    """

    def __init__(self, session_id: str, step: int) -> None:
        self.session_id = session_id
        self.step = step
        self.decision: int | None = None  # number of the next decision in the session
        self.episode: int | None = None
        self.route = Route(session_id)
        self.order = FeatureOrder()  # of the robot's elements
        self._unacknowledged: Unacknowledged | None = None

    def begin(self, opened: Opened, reopens: bool) -> None:
        """Moves to a session that was opened now.

        A session that no store has stays at its server, unless a lost session is opened again.
        """
        self.session_id, self.route, self.order = opened.session_id, opened.route, opened.order
        self.step = self.decision = self.episode = 0
        is_stored = opened.opening.durability in ("ASYNC", "SYNC")
        self.route.is_pinned = not is_stored and not reopens
        self._unacknowledged = Unacknowledged() if is_stored else None

    def act(
        self,
        observation: ArrayLike,
        reward: float | None,
        timeout: float | None = None,
        executed_action: ExecutedLike | None = None,
    ) -> Call[Decision]:
        """Describes Session.act. The response moves the cursor to the next step."""
        check(self.step == 0 or reward is not None, "reward", "one after step 0", None)
        request = METHODS["Act"].request(
            session_id=self.session_id,
            step=self.step,
            observation=observation_array(self.order.observation(observation)),
            reward=0.0 if self.step == 0 or reward is None else float(reward),
            executed_action=action_to_wire(self.order.executed(executed_action)),
            executed_source=source_to_wire(executed_action),
            decision=self.decision,
            traceparent=active_traceparent(),  # for streams, whose metadata is that of one call
        )
        accept = functools.partial(self.accept, request)
        return self._call("Act", request, accept, self.missing, timeout)

    def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
        executed_action: ExecutedLike | None = None,
    ) -> Call[EpisodeSummary]:
        """Describes Session.end_episode. The response moves the cursor to step 0."""
        request = METHODS["EndEpisode"].request(
            session_id=self.session_id,
            reward=float(reward),
            terminated=bool(terminated),
            truncated=bool(truncated),
            target_return=target_return,
            observation=()
            if observation is None
            else observation_array(self.order.observation(observation)),
            executed_action=action_to_wire(self.order.executed(executed_action)),
            executed_source=source_to_wire(executed_action),
            episode=self.episode,
            steps=None if self.episode is None else self.step,
        )

        def accept(response: Message) -> EpisodeSummary:
            self._keep("EndEpisode", self.decision, request, response)
            self.step = 0
            if self.episode is not None:
                self.episode += 1
            return EpisodeSummary.from_wire(response)

        return self._call("EndEpisode", request, accept, self.missing)

    def state(self, include_head_delta: bool = False) -> Call[SessionState]:
        """Describes Session.state."""
        request = METHODS["GetSession"].request(
            session_id=self.session_id, include_head_delta=include_head_delta
        )

        def accept(response: Message) -> SessionState:
            self._check_is_current("GetSession", response.decisions, response.episode)
            return SessionState.from_wire(response)

        return self._call("GetSession", request, accept, self._missing_or_last)

    def explain(self) -> Call[Explanation]:
        """Describes Session.explain."""
        request = METHODS["Explain"].request(session_id=self.session_id)

        def accept(response: Message) -> Explanation:
            is_last = response.answer.step == self.step - 1 and response.episode == self.episode
            if self.decision is not None and not is_last:
                self._check_is_current("Explain", 0, 0)
            return Explanation.from_wire(response)

        return self._call("Explain", request, accept, self._missing_or_last)

    def close(self) -> Call[None]:
        """Describes Session.close."""
        request = METHODS["CloseSession"].request(session_id=self.session_id)
        return Call(
            "CloseSession",
            request,
            lambda _: None,
            already_done=NotFoundError,
            session_id=self.session_id,
            route=self.route,
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

    def accept(self, request: Message, response: Message) -> Decision:
        """Returns the decision of the answer to this step and moves to the next step."""
        self.check(response)
        self._keep("Act", self.decision, request, response)
        self.step += 1
        if self.decision is not None:
            self.decision += 1
        return self.order.decision(Decision.from_wire(response))

    def missing(self, error: SpikeserveError) -> list[Call[None]]:
        """Returns the calls that the server misses, if it expects an older decision: Call.missing.

        Returns none if they are not kept, or if the server misses none.
        """
        expected = expected_decision(error)
        if expected is None or self._unacknowledged is None:
            return []
        return self._unacknowledged.calls_from(expected, self.route)

    def is_outdated(self, error: SpikeserveError) -> bool:
        """Returns whether the server expects a decision that is no longer kept: Call.is_outdated.

        It writes what it had once, after the store has lost the session. Another server may have a
        newer copy, which replaces that.
        """
        expected = expected_decision(error)
        if expected is None or not self._unacknowledged:
            return False
        return self._unacknowledged.oldest > expected

    def _missing_or_last(self, error: SpikeserveError) -> list[Call[None]]:
        if expected_decision(error) is None or self._unacknowledged is None:
            return []
        return self.missing(error) or self._unacknowledged.last_call(self.route)

    def _check_is_current(self, method: str, decisions: int, episode: int) -> None:
        """Raises FailedPreconditionError if the server knows less than has happened.

        A former owner may have all decisions, but not the end of the last episode.
        """
        if not self._unacknowledged or self.decision is None or self.episode is None:
            return
        if decisions < self.decision or episode < self.episode:
            message = (
                f"decisions: expected {self.decision} in episode {self.episode}, "
                f"received {decisions} in episode {episode}"
            )
            code = grpc.StatusCode.FAILED_PRECONDITION
            raise make_error(method, code, message, expected_decision=decisions)

    def _call(
        self,
        method: str,
        request: Message,
        decode: Callable[[Message], T],
        missing: Callable[[SpikeserveError], list[Call[None]]],
        timeout: float | None = None,
    ) -> Call[T]:
        return Call(
            method,
            request,
            decode,
            timeout,
            session_id=self.session_id,
            route=self.route,
            missing=missing,
            is_outdated=self.is_outdated,
        )

    def _keep(self, method: str, decision: int | None, request: Message, answer: Message) -> None:
        if self._unacknowledged is not None and decision is not None:
            self._unacknowledged.add(method, decision, request, answer)
