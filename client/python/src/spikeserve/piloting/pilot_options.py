"""`PilotOptions`: the settings of a pilot."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.values import Action, ActionLike, SessionOptions

MOST_IN_FLIGHT = 64  # requests; a connection may have 100 calls, and one stream more than enough
TRANSPORTS = ("auto", "stream", "datagram")
LEAST_AGE = 0.25  # seconds: half of a slow round trip's worth of answers is no use to a robot


@dataclass(frozen=True)
class PilotOptions:
    """How a pilot finds the action of a beat. ValueError if a field is out of its range.

    The fallback order, from the best to the last one:

    | source  | action                                               | setting                    |
    | ------- | ---------------------------------------------------- | -------------------------- |
    | "fresh" | an answer of the server, at most `max_age` old       | `max_age`                  |
    | "held"  | the last fresh action again, for a few beats         | `hold_beats`; 0: never     |
    | "local" | the engine on the robot, which plays the same session | `local`, `local_policy`   |
    | "safe"  | the way to the neutral action, then that action      | `neutral`, `ramp_beats`    |
    | "safe"  | after it, what the robot's own function returns      | `fallback`                 |
    """

    period: float  # seconds between two beats
    budget: float | None = None  # seconds that a beat may wait for an answer; None: half a period
    # Seconds after its observation from which on an answer is stale, and never executed. None:
    # 0.25, or three periods if that is more.
    max_age: float | None = None
    hold_beats: int = 3
    # Whether to use the engine on the robot. None: if the package spikeserve-engine is installed,
    # and the policy file is at `local_policy` or comes from the server.
    local: bool | None = None
    # The policy file, or the folder DIR of DIR/<policy>/<version>/policy.safetensors.
    local_policy: str | os.PathLike[str] | None = None
    neutral: ActionLike | None = None  # None: the neutral action of the policy
    ramp_beats: int | None = None  # None: those of 0.2 seconds; 0: no ramp
    # (observation) -> action. Every element of an observation that is not valid is NaN.
    fallback: Callable[[NDArray[np.float32]], ActionLike] | None = None
    in_flight: int | None = None  # most requests without an answer; None: those of `max_age`
    # How steps go to the server. "auto": as datagrams where the server takes them and they come
    # through, if `cryptography` is installed (the extra `datagrams` of the package). "stream": over
    # the stream. "datagram": as "auto"; a server that takes no datagrams is refused.
    transport: str = "auto"
    redundancy: int = 1  # how often each datagram is sent, 1 or 2
    kept_beats: int = 8192  # that the server has not acknowledged; older ones become rewards only
    session: SessionOptions = field(default_factory=SessionOptions)
    close_timeout: float = 5.0  # seconds for the ends of episodes that the server does not have yet

    def __post_init__(self) -> None:
        check(0.001 <= self.period <= 3600, "period", "0.001 to 3600 s", self.period)
        budget = self.period if self.budget is None else self.budget
        check(0 <= budget <= self.period, "budget", f"0 to period ({self.period})", self.budget)
        check(self.max_age is None or self.max_age > 0, "max_age", "more than 0", self.max_age)
        check(self.hold_beats >= 0, "hold_beats", "at least 0", self.hold_beats)
        ramp = self.ramp_beats
        check(ramp is None or ramp >= 0, "ramp_beats", "at least 0", ramp)
        expected = f"1 to {MOST_IN_FLIGHT}"
        check(1 <= self.most_in_flight <= MOST_IN_FLIGHT, "in_flight", expected, self.in_flight)
        check(self.transport in TRANSPORTS, "transport", f"one of {TRANSPORTS}", self.transport)
        check(self.redundancy in (1, 2), "redundancy", "1 or 2", self.redundancy)
        check(self.kept_beats >= 2, "kept_beats", "at least 2", self.kept_beats)
        least = self.close_timeout
        check(least >= 0, "close_timeout", "at least 0", least)
        given = self.local is True or self.local is None or self.local_policy is None
        check(given, "local_policy", "none with local=False", self.local_policy)

    @property
    def wait(self) -> float:
        """Returns how long a beat may wait for an answer, in seconds."""
        return self.period / 2 if self.budget is None else self.budget

    @property
    def oldest(self) -> float:
        """Returns the age of the oldest answer that may be executed, in seconds."""
        return max(LEAST_AGE, 3 * self.period) if self.max_age is None else self.max_age

    @property
    def oldest_held(self) -> float:
        """Returns the age of the oldest action that may be held, in seconds."""
        return self.oldest + self.hold_beats * self.period

    @property
    def ramp(self) -> int:
        """Returns the number of beats from the last action to the neutral one."""
        return math.ceil(0.2 / self.period) if self.ramp_beats is None else self.ramp_beats

    @property
    def most_in_flight(self) -> int:
        """Returns the most requests without an answer: later answers would be stale."""
        if self.in_flight is not None:
            return self.in_flight
        beats = min(self.oldest / self.period, MOST_IN_FLIGHT)  # finite, so that it can be rounded
        return min(max(4, math.ceil(beats) + 1), MOST_IN_FLIGHT)


@dataclass(frozen=True)
class PilotAction:
    """The action of one beat.

    `age` is the time in seconds from the observation that the action was chosen for to the return
    of `beat`, with the time in which the computer was suspended; of a safe action, from the last
    observation that an action was chosen for. `beat` counts the beats of the pilot from 0.
    """

    action: Action
    source: str  # "fresh", "held", "local" or "safe"
    age: float
    beat: int
