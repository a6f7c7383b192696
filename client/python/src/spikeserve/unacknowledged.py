"""The last requests of a session, which its next server may miss.

A server answers a session of durability ASYNC before the store has the decision, and a store may
lose what it has acknowledged: Redis, when a copy takes its place that is behind. The next server
then expects an older decision. The client sends these requests again, in order, and gets the same
answers, because a decision depends only on the requests of its session.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from spikeserve.calls import Call, error_of_result
from spikeserve.errors import DivergedError, SpikeserveError, for_session
from spikeserve.wire import METHODS, Message

if TYPE_CHECKING:
    from spikeserve.replicas import Route

# The most decisions of one session that a server lets wait for the store, and that are kept.
MOST_DECISIONS = 256


@dataclass
class _Answered:
    """A request and its answer, serialized, which takes a fraction of the memory of messages."""

    method: str  # Act or EndEpisode
    decision: int  # of an Act; of an EndEpisode: the decision that follows it
    request_bytes: bytes
    answer_bytes: bytes

    @property
    def request(self) -> Message:
        return METHODS[self.method].request.FromString(self.request_bytes)

    @property
    def answer(self) -> Message:
        return METHODS[self.method].response.FromString(self.answer_bytes)

    def take(self, answer: Message) -> None:
        """Takes the answer to a request that was sent again. DivergedError if it is another one."""
        before = self.answer
        self.answer_bytes = answer.SerializeToString()
        if _is_policys(before, answer) and _comparable(before) != _comparable(answer):
            raise DivergedError.of(self.method, self.request.session_id, self.decision)


class Unacknowledged:
    """Keeps the last answered requests, with at most MOST_DECISIONS decisions."""

    def __init__(self) -> None:
        self._answered: collections.deque[_Answered] = collections.deque()

    def __len__(self) -> int:
        return len(self._answered)

    @property
    def oldest(self) -> int:
        """Returns the decision of the oldest request. REQUIRES: there is one."""
        return self._answered[0].decision

    def add(self, method: str, decision: int, request: Message, answer: Message) -> None:
        """Adds an answered request."""
        self._answered.append(
            _Answered(method, decision, request.SerializeToString(), answer.SerializeToString())
        )
        while self._answered[0].decision <= decision - MOST_DECISIONS:
            self._answered.popleft()

    def calls_from(self, decision: int, route: Route) -> list[Call[None]]:
        """Describes the calls that send everything again from `decision` on, in order.

        Returns none if the requests from there on are not kept.
        """
        if not self._answered or self._answered[0].decision > decision:
            return []
        return list(self._calls(decision, route))

    def last_call(self, route: Route) -> list[Call[None]]:
        """Describes the call that sends the last request again.

        A server whose copy of the session is an old one claims the session for it.
        """
        return list(self._calls(self._answered[-1].decision, route)) if self._answered else []

    def _calls(self, decision: int, route: Route) -> Iterator[Call[None]]:
        wanted = [answered for answered in self._answered if answered.decision >= decision]
        for method, group in groupby(wanted, lambda answered: answered.method):
            if method == "Act":
                yield _act_again(list(group), route)
            else:
                for ending in group:
                    yield Call(
                        method,
                        ending.request,
                        ending.take,
                        session_id=ending.request.session_id,
                        route=route,
                    )


def _act_again(acts: list[_Answered], route: Route) -> Call[None]:
    """Describes one ActBatch of consecutive decisions of a session."""

    def decode(response: Message) -> None:
        diverged: SpikeserveError | None = None
        for act, result in zip(acts, response.results, strict=True):
            if result.code != 0:
                raise for_session(error_of_result(result), act.request.session_id)
            try:
                act.take(result.response)
            except DivergedError as error:
                diverged = diverged or error
        if diverged is not None:
            raise diverged

    request = METHODS["ActBatch"].request(requests=[act.request for act in acts])
    return Call("ActBatch", request, decode, route=route)


def _is_policys(*answers: Message) -> bool:
    """Returns whether the policy chose all of the answers: a hold or an operator may have ended."""
    acts = [answer for answer in answers if answer.DESCRIPTOR.name == "ActResponse"]
    return not any(answer.HasField("source") for answer in acts)


def _comparable(answer: Message) -> bytes:
    """Returns the bytes of an answer without what may differ between servers and attempts."""
    copy = type(answer)()
    copy.CopyFrom(answer)
    if copy.DESCRIPTOR.name == "ActResponse":
        copy.stats.ClearField("compute_seconds")
        copy.ClearField("durable_decision")
        copy.ClearField("durable_episode")
        for field in ("next_step", "appended", "dropped", "queue_seconds", "append_seconds"):
            copy.ClearField(field)
    else:
        copy.ClearField("recording")
    return bytes(copy.SerializeToString(deterministic=True))
