"""When a failed call is sent again, and after what pause."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import grpc

from spikeserve.calls import Call
from spikeserve.check import check
from spikeserve.errors import error_of_call, is_retryable


@dataclass(frozen=True)
class RetryOptions:
    """Exponential backoff. Only calls that end with UNAVAILABLE or DEADLINE_EXCEEDED are repeated.

    The pause before attempt n + 1 is initial_backoff * multiplier^(n-1) seconds, at most
    max_backoff seconds, times a random factor in [0.5, 1]. The random factor spreads out callers
    that failed at the same time. ValueError if a field is out of its range.
    """

    max_attempts: int = 5  # 1: never repeat
    initial_backoff: float = 0.05  # seconds
    max_backoff: float = 2.0  # seconds
    multiplier: float = 2.0

    def __post_init__(self) -> None:
        initial = self.initial_backoff
        check(self.max_attempts >= 1, "max_attempts", "at least 1", self.max_attempts)
        check(initial >= 0, "initial_backoff", "at least 0", initial)
        least = f"at least initial_backoff ({initial})"
        check(self.max_backoff >= initial, "max_backoff", least, self.max_backoff)
        check(self.multiplier >= 1, "multiplier", "at least 1", self.multiplier)

    def pauses(self) -> Iterator[float]:
        """Yields the pauses between the attempts of one call, in seconds: max_attempts - 1."""
        backoff = self.initial_backoff
        for _ in range(self.max_attempts - 1):
            yield backoff * random.uniform(0.5, 1.0)
            backoff = min(backoff * self.multiplier, self.max_backoff)


class Attempts:
    """Counts the failed attempts of one call and decides what follows each of them."""

    def __init__(self, call: Call[Any], options: RetryOptions) -> None:
        self._call = call
        self._pauses = options.pauses()
        self._failed = 0

    def pause_after(self, rpc_error: grpc.RpcError) -> float | None:
        """Returns the seconds to wait before the next attempt.

        Returns None if an earlier attempt has taken effect. Raises the SpikeserveError of
        `rpc_error` if there is no next attempt.
        """
        error = error_of_call(self._call.method, rpc_error)
        self._failed += 1
        done = self._call.already_done
        if done is not None and self._failed > 1 and isinstance(error, done):
            return None
        may_repeat = self._call.repeatable and is_retryable(error)
        pause = next(self._pauses, None) if may_repeat else None
        if pause is None:
            raise error from rpc_error
        return pause
