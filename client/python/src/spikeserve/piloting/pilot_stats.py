"""`PilotStats`: what a pilot has done."""

from __future__ import annotations

from dataclasses import dataclass


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
    datagram_answers: int = 0  # answers that came as datagrams
    sends_datagrams: bool = False  # steps go as datagrams now, and no longer over the stream
    reconnects: int = 0  # streams that were opened in the place of another one
    reopened: int = 0  # sessions that were opened in the place of a lost one
    dropped: int = 0  # beats that the server got as rewards only
    lost_episodes: int = 0  # episodes whose end the server never learned
    unequal_returns: int = 0  # episodes whose return at the server was not that at the robot
    invalid: int = 0  # observations, rewards or executed actions that were not valid
    invalid_observations: int = 0  # beats without a valid observation
    last_invalid_observation: str = ""  # what was expected and received; empty: all were valid
    failures: int = 0  # calls of the fall-back that failed
    longest_gap: float = 0.0  # without a fresh action
    age_p50: float = 0.0  # of the actions, without the safe ones
    age_p99: float = 0.0
    age_p999: float = 0.0
    has_local: bool = False  # whether the engine on the robot is ready
    # Whether the engine on the robot plays with a shared head as of the last episode, which the
    # fleet may have changed meanwhile.
    local_head_is_copy: bool = False
    # The server keeps the robot at its safe action: the session is held, or looks miswired.
    stays_safe: bool = False
