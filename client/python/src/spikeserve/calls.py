"""The calls of the service: the request that each one sends and the value of its response.

The blocking client and the asyncio client both run these descriptions (see caller.py). Nothing
in this module sends or waits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from spikeserve.errors import SpikeserveError, error_of_item
from spikeserve.feature_order import FeatureOrder
from spikeserve.replicas import Route, draw_id
from spikeserve.values import AmendedEpisode, Opening, Policy, SessionOptions
from spikeserve.wire import METHODS, Message

T = TypeVar("T")


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
    route: Route = field(default_factory=Route)
    # Looks for items of the response that may be sent again; None: the call has no items.
    failed_items: Callable[[Message], FailedItems | None] | None = None
    # Returns the calls that bring a session up to date whose server answered with an error, because
    # the store did not have all decisions of the session when it was claimed. Empty: there are
    # none. None: the call does not depend on earlier ones.
    missing: Callable[[SpikeserveError], list[Call[None]]] | None = None
    # Returns whether the server has an older copy of the session than those calls can bring up to
    # date, so that another one is asked. None: the call does not depend on earlier ones.
    is_outdated: Callable[[SpikeserveError], bool] | None = None


@dataclass(frozen=True)
class FailedItems:
    """The items of a batch that the server refused for now, or for which it misses decisions.

    `request` asks for them again after the calls of `missing`. `merge` puts the items of its
    response into the first response. `error` is the error of the item that needs the longest pause.
    """

    request: Message
    error: SpikeserveError
    merge: Callable[[Message], None]
    missing: list[Call[None]]


def list_policies() -> Call[list[Policy]]:
    """Describes Client.list_policies."""
    request = METHODS["ListPolicies"].request()
    return Call("ListPolicies", request, lambda r: [Policy.from_wire(p) for p in r.policies])


def amend_episode(
    session: str,
    episode: int,
    amendment_id: str,
    *,
    rewards: Sequence[float] = (),
    reward: float | None = None,
    success: bool | None = None,
    label: str = "",
    author: str = "",
) -> Call[AmendedEpisode]:
    """Describes Client.amend_episode."""
    request = METHODS["AmendEpisode"].request(
        session_id=session,
        episode=episode,
        amendment_id=amendment_id,
        rewards=rewards,
        reward=reward,
        success=success,
        label=label,
        author=author,
    )
    # Of a session of which nothing more is known, or of a recording.
    return Call("AmendEpisode", request, AmendedEpisode.from_wire, route=Route(session))


@dataclass(frozen=True)
class Opened:
    """A session that the server has opened."""

    session_id: str
    opening: Opening
    route: Route
    order: FeatureOrder = field(default_factory=FeatureOrder)


def named(
    options: SessionOptions | None, observation: Sequence[str], action: Sequence[str]
) -> SessionOptions:
    """Returns `options` with the names of a robot's elements, if there are any."""
    options = options or SessionOptions()
    return replace(
        options,
        observation=tuple(observation) or options.observation,
        action=tuple(action) or options.action,
    )


def open_session(
    policy: str, options: SessionOptions | None, route: Route | None = None
) -> Call[Opened]:
    """Describes Client.open_session, with a new session id.

    The calls of the session take the way of `route`; None: a way of their own.
    """
    options = options or SessionOptions()
    request = options.to_wire(policy)
    request.session_id = draw_id()
    route = route or Route(request.session_id)

    def decode(response: Message) -> Opened:
        opening = Opening.from_wire(response)
        order = FeatureOrder.of(opening, options.observation, options.action)
        return Opened(response.session_id, opening, route, order)

    return Call("OpenSession", request, decode, route=route)


def error_of_result(result: Any) -> SpikeserveError:
    """Returns the error of an ActResult."""
    return error_of_item("Act", result)
