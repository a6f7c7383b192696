"""`PilotStats`: what a pilot has done, in bounded memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from spikeserve.wire import Message, message_class

_FIRST = 1e-5  # seconds; shorter ages count as this one
_GROWTH = 1.02  # from one bucket of ages to the next: percentiles are exact to 2 %
_BUCKETS = 1000  # the last one begins at an hour


@dataclass(frozen=True)
class PilotStats:
    """Counts since the pilot began. Times are in seconds."""

    beats: int = 0
    fresh: int = 0
    held: int = 0
    local: int = 0
    safe: int = 0
    entries: dict[str, int] | None = None  # how often each source was entered
    stale: int = 0  # answers that came too late, and were not executed
    late_answers: int = 0  # answers that took longer than a period; they may be fresh still
    cancelled_calls: int = 0  # requests that failed, or were given up with their stream
    reconnects: int = 0  # streams that were opened in the place of another one
    reopened: int = 0  # sessions that were opened in the place of a lost one
    dropped: int = 0  # beats that the server got as rewards only
    lost_episodes: int = 0  # episodes whose end the server never learned
    unequal_returns: int = 0  # episodes whose return at the server was not that at the robot
    invalid: int = 0  # observations, rewards or executed actions that were not valid
    invalid_observations: int = 0  # beats without a valid observation
    last_invalid_observation: str = ""  # what was expected and received; empty: all were valid
    failures: int = 0  # beats in which the pilot itself failed
    longest_gap: float = 0.0  # without a fresh action
    age_p50: float = 0.0  # of the actions, without the safe ones
    age_p99: float = 0.0
    age_p999: float = 0.0
    has_local: bool = False  # whether the engine on the robot is ready
    # Whether the engine on the robot plays with a shared head as of the last episode, which the
    # fleet may have changed meanwhile.
    local_head_is_copy: bool = False


class Ages:
    """Counts ages in buckets that grow by 2 %."""

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self._total = 0

    def add(self, age: float) -> None:
        """Counts an age in seconds."""
        index = 0 if age <= _FIRST else int(math.log(age / _FIRST) / math.log(_GROWTH))
        self._counts[min(index, _BUCKETS - 1)] += 1
        self._total += 1

    def quantile(self, share: float) -> float:
        """Returns the age in seconds that `share` of the ages do not exceed; 0: there are none."""
        left = math.ceil(share * self._total)
        for index, count in enumerate(self._counts):
            left -= count
            if count and left <= 0:
                return float(_FIRST * _GROWTH ** (index + 0.5))
        return 0.0


class Counters:
    """Counts what a pilot does. Not thread-safe: the lock of the pilot guards it."""

    def __init__(self, began: float) -> None:
        self.stats = PilotStats()
        self._ages = Ages()
        self._fresh_at = began  # time.monotonic() of the last fresh action
        self._longest_gap = 0.0
        self._reported_gap = 0.0  # the longest since the last report
        self._oldest_age = 0.0  # since the last report
        self._reported_at = 0.0

    def count(self, **changes: int) -> None:
        """Adds to counts by name."""
        grown = {name: getattr(self.stats, name) + change for name, change in changes.items()}
        self.stats = replace(self.stats, **grown)

    def beat(self, source: str, age: float, now: float) -> None:
        """Counts a beat."""
        self.count(beats=1, **{source: 1})
        if source != "safe":
            self._ages.add(age)
        self._oldest_age = max(self._oldest_age, age)
        gap = now - self._fresh_at
        self._longest_gap = max(self._longest_gap, gap)
        self._reported_gap = max(self._reported_gap, gap)
        if source == "fresh":
            self._fresh_at = now

    def is_report_due(self, now: float) -> bool:
        """Returns whether a second has passed since the last report."""
        return now - self._reported_at >= 1.0

    def report(self, now: float) -> Message | None:
        """Returns the BeatReport that is due, about once a second; None: none is."""
        if not self.is_report_due(now):
            return None
        stats = self.stats
        report = message_class("BeatReport")(
            fresh=stats.fresh,
            held=stats.held,
            local=stats.local,
            safe=stats.safe,
            late_answers=stats.late_answers,
            cancelled_calls=stats.cancelled_calls,
            reconnects=stats.reconnects,
            longest_gap_seconds=self._reported_gap,
            oldest_age_seconds=self._oldest_age,
            invalid_observations=stats.invalid_observations,
        )
        self._reported_at, self._reported_gap, self._oldest_age = now, 0.0, 0.0
        return report

    def snapshot(self, **others: Any) -> PilotStats:
        """Returns the counts with the figures that are computed from all beats, and `others`."""
        return replace(
            self.stats,
            **others,
            longest_gap=self._longest_gap,
            age_p50=self._ages.quantile(0.5),
            age_p99=self._ages.quantile(0.99),
            age_p999=self._ages.quantile(0.999),
        )
