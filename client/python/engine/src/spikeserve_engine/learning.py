"""`Learning`: how a session learns."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Learning:
    """Configures the plasticity of the action head, as LearningConfig of the server does.

    None or an empty string selects the default.
    """

    scope: str = "SESSION"  # SESSION: a private copy of the action head; FLEET: the shared head
    rule: str = ""  # policy_gradient (default), hebbian, hebbian_action or corrections
    modulator: str = ""  # realized (default) or target
    learning_rate: float | None = None
    trace_decay: float | None = None
    discount: float | None = None  # realized only
    clip: float | None = None
    max_drift: float | None = None  # SESSION only
    guard_margin: float | None = None  # SESSION only
    verdict_seconds: float | None = None  # for sessions of a server, which takes the verdicts
