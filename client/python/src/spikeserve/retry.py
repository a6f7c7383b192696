"""When a failed call is made again, and after what pause."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class RetryOptions:
    """Exponential backoff, in seconds.

    The pause before attempt n + 1 is initial_backoff * multiplier^(n-1), at most max_backoff,
    times a factor in [0.5, 1] that spreads out callers who failed together. Calls that end with
    UNAVAILABLE or DEADLINE_EXCEEDED are repeated, no others.
    """

    max_attempts: int = 5  # 1: never repeat
    initial_backoff: float = 0.05
    max_backoff: float = 2.0
    multiplier: float = 2.0

    def __post_init__(self) -> None:
        if self.max_attempts < 1:
            raise ValueError(f"max_attempts: expected at least 1, got {self.max_attempts}")
        if not self.initial_backoff >= 0:
            raise ValueError(f"initial_backoff: expected at least 0, got {self.initial_backoff}")
        if not self.max_backoff >= self.initial_backoff:
            raise ValueError(
                f"max_backoff: expected at least initial_backoff ({self.initial_backoff}), "
                f"got {self.max_backoff}"
            )
        if not self.multiplier >= 1:
            raise ValueError(f"multiplier: expected at least 1, got {self.multiplier}")

    def pauses(self) -> Iterator[float]:
        """The pauses of one call, one fewer than its attempts."""
        backoff = self.initial_backoff
        for _ in range(self.max_attempts - 1):
            yield backoff * random.uniform(0.5, 1.0)
            backoff = min(backoff * self.multiplier, self.max_backoff)
