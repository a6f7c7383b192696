"""When a failed call is sent again, and after what pause."""

from __future__ import annotations

import itertools
import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import grpc

from spikeserve.calls import Call, FailedItems
from spikeserve.check import check
from spikeserve.errors import (
    DeadlineExceededError,
    NotFoundError,
    SessionLostError,
    SpikeserveError,
    error_of_call,
    for_session,
    is_retryable,
    was_refused,
)
from spikeserve.replicas import Replica, Replicas


@dataclass(frozen=True)
class RetryOptions:
    """Which calls are repeated, how often and after what pauses.

    A call that ends with UNAVAILABLE or DEADLINE_EXCEEDED is repeated after initial_backoff *
    multiplier^(n-1) seconds for attempt n + 1, at most max_backoff seconds, times a random factor
    in [0.5, 1]. The random factor spreads out callers that failed at the same time. A call that
    the server refused with RESOURCE_EXHAUSTED and the time of the next try is repeated after that
    time. No attempt begins later than max_elapsed seconds after the first one, which outlasts the
    restart of a server, or after the timeout that the call was given. With several servers, the
    next attempt goes to another one. ValueError if a field is out of its range.
    """

    max_attempts: int | None = None  # 1: never repeat; None: limited by max_elapsed only
    max_elapsed: float = 30.0  # seconds
    initial_backoff: float = 0.05  # seconds
    max_backoff: float = 2.0  # seconds
    multiplier: float = 2.0

    def __post_init__(self) -> None:
        initial, attempts = self.initial_backoff, self.max_attempts
        check(attempts is None or attempts >= 1, "max_attempts", "at least 1", attempts)
        check(self.max_elapsed >= 0, "max_elapsed", "at least 0", self.max_elapsed)
        check(initial >= 0, "initial_backoff", "at least 0", initial)
        least = f"at least initial_backoff ({initial})"
        check(self.max_backoff >= initial, "max_backoff", least, self.max_backoff)
        check(self.multiplier >= 1, "multiplier", "at least 1", self.multiplier)

    def pauses(self) -> Iterator[float]:
        """Yields the pauses between the attempts of one call, in seconds: max_attempts - 1."""
        backoff = self.initial_backoff
        for attempt in itertools.count(1):
            if attempt == self.max_attempts:
                return
            yield backoff * random.uniform(0.5, 1.0)
            backoff = min(backoff * self.multiplier, self.max_backoff)


class Patience:
    """The pauses of one call or stream that still fit into its time."""

    def __init__(self, options: RetryOptions, limit: float | None = None) -> None:
        elapsed = options.max_elapsed if limit is None else min(options.max_elapsed, limit)
        self._pauses = options.pauses()
        self._ends = time.monotonic() + elapsed

    def pause_after(self, error: SpikeserveError) -> float | None:
        """Returns the seconds to wait before the next attempt, or None if there is none."""
        if not (is_retryable(error) or was_refused(error)):
            return None
        return self.next_pause(error.retry_after)

    def next_pause(self, asked_for: float | None = None) -> float | None:
        """As pause_after, after any error. `asked_for` is the pause that the server asked for."""
        pause = next(self._pauses, None)
        if pause is None:
            return None
        if asked_for is not None:
            # Never earlier than the server asked for, and not all callers at once.
            pause = asked_for + random.uniform(0.0, 0.1) * asked_for
        return pause if time.monotonic() + pause < self._ends else None

    def shorten(self, seconds: float) -> None:
        """Ends the time at most `seconds` from now on."""
        self._ends = min(self._ends, time.monotonic() + seconds)


class Attempts:
    """Counts the failed attempts of one call and decides what follows each of them.

    `timeout` is that of each attempt in seconds. The timeout of the call itself, if it has one,
    bounds all attempts and pauses together. `connect_timeout` bounds the attempts to reach a server
    that was never reached before; None: it was.
    """

    def __init__(
        self,
        call: Call[Any],
        options: RetryOptions,
        timeout: float,
        connect_timeout: float | None,
        replicas: Replicas,
    ) -> None:
        self._call = call
        self._timeout = timeout
        self._deadline = None if call.timeout is None else time.monotonic() + call.timeout
        self._patience = Patience(options, call.timeout)
        if connect_timeout is not None:
            self._patience.shorten(connect_timeout)
        self._failed = 0
        self._rounds = 0  # of missing decisions
        self._replicas = replicas
        self._tried: set[Replica] = set()
        self._without: set[Replica] = set()  # those that have denied `_denied` in a row
        self._denied: Sequence[str] = ()
        self.replica = replicas.choose(call.route)

    def timeout(self) -> float:
        """Returns the timeout of the next attempt in seconds."""
        if self._deadline is None:
            return self._timeout
        return max(self._deadline - time.monotonic(), 0.001)

    def answered(self) -> None:
        """Notes that `replica` answered the call."""
        self._replicas.answered(self._call.route, self.replica)

    def pause_after(self, rpc_error: grpc.RpcError, seconds: float) -> float | None:
        """Returns the seconds to wait before the next attempt, which goes to `replica`.

        `seconds` is the timeout of the failed attempt. Returns None if an earlier attempt has taken
        effect. Raises the SpikeserveError of `rpc_error` if there is no next attempt.
        """
        error = error_of_call(self._call.method, rpc_error)
        self._failed += 1
        done = self._call.already_done
        if done is not None and self._failed > 1 and isinstance(error, done):
            return None
        pause = None
        if self._call.repeatable or was_refused(error):
            pause = self.pause_for(error, seconds)
        if pause is None:
            if self._call.session_id:
                error = for_session(error, self._call.session_id)
            raise error from rpc_error
        return pause

    def pause_for(self, error: SpikeserveError, seconds: float | None = None) -> float | None:
        """Returns the seconds to wait before the call or a part of it is sent again, or None.

        Chooses another replica if the error says that this one cannot answer now. `seconds` is how
        long the call had no answer, if it had none.
        """
        is_missing = isinstance(error, NotFoundError) and self._call.session_id != ""
        is_missing = is_missing or isinstance(error, SessionLostError)
        is_outdated = self._call.is_outdated
        is_missing = is_missing or (is_outdated is not None and is_outdated(error))
        if not self._replicas.may_move(self._call.route) or not (is_missing or is_retryable(error)):
            return self._patience.pause_after(error)
        if is_missing:
            if self._is_lost(error):
                return None
        else:
            self._without.clear()
            is_silent = isinstance(error, DeadlineExceededError)
            self._replicas.failed(self.replica, seconds if is_silent else None)
        self._tried.add(self.replica)
        if all_tried := len(self._tried) == len(self._replicas):
            self._tried = set(self._without)
        self.replica = self._replicas.choose(self._call.route, self._tried)
        return self._patience.next_pause(error.retry_after if all_tried else None)

    def _is_lost(self, error: SpikeserveError) -> bool:
        """Notes that `replica` does not know the session, or those of a batch that have failed.

        Another one may hold what the store has lost, and a session may move from one that has not
        been asked yet to one that did not know it. So it is lost when all say so in a row.
        """
        sessions = error.session_ids if isinstance(error, SessionLostError) else ()
        if sessions != self._denied:
            self._without.clear()
            self._denied = sessions
        self._without.add(self.replica)
        return len(self._without) == len(self._replicas)

    def pause_before_part(self, failed: FailedItems) -> float | None:
        """Returns the seconds to wait before failed items are sent again, or None."""
        return self.pause_before_missing() if failed.missing else self.pause_for(failed.error)

    def pause_before_missing(self) -> float | None:
        """Returns the seconds to wait before decisions that the server misses are sent, or None.

        A server that has just claimed a session misses decisions once, so the first time has no
        pause.
        """
        self._without.clear()  # it knows the session
        self._rounds += 1
        return 0.0 if self._rounds == 1 else self._patience.next_pause()
