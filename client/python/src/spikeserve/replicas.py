"""The servers of a client, and which of them a call goes to.

Servers that keep their sessions in one store are replicas: each of them can continue with every
session. The calls of a session go to the same replica while it answers, because a session that
moves costs a claim. Nothing here sends or waits.
"""

from __future__ import annotations

import secrets
import time
import weakref
from collections.abc import Callable, Collection, Sequence
from typing import Any, Protocol

from spikeserve.check import check
from spikeserve.lines import Doubt, Line

AFFINITY_KEY = "spikeserve-affinity"  # the metadata by which proxies choose a server

# How long a server may take to say that it serves. A call that had no answer for this time shows
# that the server cannot be reached.
PROBE_SECONDS = 1.0


class Cancellable(Protocol):
    """A call that can be cancelled."""

    def cancel(self) -> Any:
        """Ends the call, if it has not ended."""


class Replica:
    """One server of a client: its address and the line to it, which a fresh one may replace."""

    def __init__(self, address: str, line: Line) -> None:
        self.address = address
        self.line = line
        self.doubt = Doubt()  # of the line
        # Those on the line. A fresh line cancels them: grpc.aio does not when it closes a channel.
        self.streams: weakref.WeakSet[Cancellable] = weakref.WeakSet()
        self.is_away = False
        self.is_probed = False  # a probe is under way
        self.probe_at = 0.0  # of time.monotonic()
        self.pause = 0.0  # seconds between the last failure and the next probe

    def renew(self, line: Line) -> None:
        """Replaces the line by a fresh one. Calls that begin from now on go there."""
        self.line = line
        for stream in list(self.streams):
            stream.cancel()


class Route:
    """What decides the server of calls that belong together: of a session, a stream or a batch.

    `key` is the affinity metadata. It ranks the servers, equally in every client. A pinned route
    stays at the server that answered last: sessions that no store has exist there only. That of a
    stream stays there while the server can be reached: the stream does not return to the server
    that it prefers, and a call beside it that did would take a session from it.
    """

    def __init__(self, key: str = "") -> None:
        self.key = key
        self.is_pinned = False
        self.has_stream = False
        self.replica: Replica | None = None  # the one that answered last
        self.ranked: Sequence[Replica] = ()


def draw_id() -> str:
    """Returns a random session id or key: 32 hexadecimal digits."""
    return secrets.token_hex(16)


def parse_servers(servers: str) -> list[str]:
    """Returns the addresses of a list that is separated by commas. ValueError if one is empty."""
    addresses = [address.strip() for address in servers.split(",")]
    expected = "HOST:PORT or unix:PATH, several separated by commas"
    check(all(addresses), "server", expected, repr(servers))
    return addresses


def rank(key: str, address: str) -> int:
    """Returns the rank of a server for a key: rendezvous hashing with FNV-1a and a final mix.

    The C++ client computes the same number, so that all clients of a session prefer one server.
    """
    mask = (1 << 64) - 1
    value = 0xCBF29CE484222325
    for byte in f"{key}@{address}".encode():
        value = ((value ^ byte) * 0x100000001B3) & mask
    for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
        value = ((value ^ (value >> 33)) * factor) & mask
    return value ^ (value >> 33)


class Replicas:
    """The replicas of a client, and which of them cannot be reached.

    A replica that failed gets no calls until `probe` has found it again, if there is another one.
    `probe` starts a health check and passes its result to `probed`, on any thread. The pauses
    before probes double from `first_pause` to `longest_pause` seconds.
    """

    def __init__(
        self,
        replicas: Sequence[Replica],
        first_pause: float,
        longest_pause: float,
        probe: Callable[[Replica], None],
    ) -> None:
        self._all = replicas
        self._first_pause = first_pause
        self._longest_pause = longest_pause
        self._probe = probe

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Any:
        return iter(self._all)

    def choose(self, route: Route, tried: Collection[Replica] = ()) -> Replica:
        """Returns the preferred replica of a route that is not away and not among `tried`.

        Returns one that cannot be reached if no other is left, and one that was tried if all were.
        """
        if len(self._all) == 1:
            return self._all[0]
        if route.is_pinned and route.replica is not None:
            return route.replica
        if not route.ranked:
            route.ranked = sorted(
                self._all, key=lambda replica: rank(route.key, replica.address), reverse=True
            )
        self._probe_those_due()
        last = route.replica
        if route.has_stream and last is not None and not last.is_away and last not in tried:
            return last
        left = [replica for replica in route.ranked if replica not in tried] or route.ranked
        return next((replica for replica in left if not replica.is_away), left[0])

    def may_move(self, route: Route) -> bool:
        """Returns whether a call of the route may go to another replica."""
        return len(self._all) > 1 and not route.is_pinned

    def failed(self, replica: Replica, silent_for: float | None = None) -> None:
        """Notes that a call failed because of its replica.

        `silent_for` is the time in seconds that a call waited in vain; None: the call was refused,
        or the connection broke. A short silence only leads to a probe.
        """
        if len(self._all) == 1:
            return
        if silent_for is not None and silent_for < PROBE_SECONDS:
            self._start_probe(replica)
            return
        self._set_away(replica)

    def answered(self, route: Route, replica: Replica) -> None:
        """Notes that a replica answered a call."""
        route.replica = replica
        replica.is_away = False
        replica.pause = 0.0

    def probed(self, replica: Replica, serves: bool) -> None:
        """Notes the result of a probe."""
        replica.is_probed = False
        if serves:
            replica.is_away = False
        else:
            self._set_away(replica)

    def _set_away(self, replica: Replica) -> None:
        replica.is_away = True
        replica.pause = min(max(2 * replica.pause, self._first_pause), self._longest_pause)
        replica.probe_at = time.monotonic() + replica.pause

    def _probe_those_due(self) -> None:
        now = time.monotonic()
        for replica in self._all:
            if replica.is_away and now >= replica.probe_at:
                self._start_probe(replica)

    def _start_probe(self, replica: Replica) -> None:
        if not replica.is_probed:
            replica.is_probed = True
            self._probe(replica)
