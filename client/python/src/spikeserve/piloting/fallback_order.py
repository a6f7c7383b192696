"""`FallbackOrder`: which action a beat gets. Nothing here waits."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import unmasked
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.spaces import ActionSpace, Box
from spikeserve.values import Action, ActionLike

LOGGER = logging.getLogger("spikeserve.pilot")
SOURCES = ("fresh", "held", "local", "safe")


@dataclass(frozen=True)
class Chosen:
    """An action, its source, and when the observation was made that it was chosen for."""

    action: Action
    source: str
    observed_at: int  # of robot_clock.now_ns()


class FallbackOrder:
    """Chooses an action for each beat. Counts and logs when a source is entered and left.

    Not thread-safe. `began_at` (robot_clock.now_ns()) stands for the observation of safe actions
    before the first one that an action was chosen for.
    """

    def __init__(
        self, options: PilotOptions, space: ActionSpace, neutral: ActionLike, began_at: int
    ) -> None:
        self._options = options
        self._space = space
        self._neutral = self.fitted(neutral)
        self._last = self._neutral  # the last action
        self._observed_at = began_at
        self._held = 0  # beats since the last fresh action that held it
        self._can_hold = False
        self._ramp_from = self._neutral
        self._ramped = 0  # beats of the ramp
        self._source = ""
        self._source_beats = 0
        self.entries = dict.fromkeys(SOURCES, 0)
        self.fallback_failures = 0

    @property
    def neutral(self) -> Action:
        """Returns the neutral action."""
        return self._neutral

    def begin_episode(self) -> None:
        """Forgets the actions of the episode before."""
        self._last, self._can_hold = self._neutral, False
        self._ramped = self._options.ramp

    def executed(self, action: Action) -> None:
        """Notes that the robot has executed another action than the last one that was chosen."""
        self._last = action

    def choose(
        self,
        fresh: tuple[Action, int] | None,
        local: Callable[[], Action | None],
        observation: NDArray[np.float32],
        observed_at: int,
        is_miswired: bool = False,
    ) -> Chosen:
        """Returns the action of a beat; a safe one if the robot `is_miswired`.

        `fresh` is a new answer that is not stale, and when its observation was made. `local` asks
        the engine on the robot. `observation` was made at `observed_at`.
        """
        if is_miswired:
            self._can_hold = False
            return self._take(self._safe(observation), "safe")
        if fresh is not None:
            action, self._observed_at = fresh
            self._held, self._can_hold = 0, True
            return self._take(action, "fresh")
        is_recent = observed_at - self._observed_at <= self._options.oldest_held * 1e9
        if self._can_hold and is_recent and self._held < self._options.hold_beats:
            self._held += 1
            return self._take(self._last, "held")
        self._can_hold = False
        own = local()
        if own is not None:
            self._observed_at = observed_at
            return self._take(own, "local")
        return self._take(self._safe(observation), "safe")

    def _take(self, action: Action, source: str) -> Chosen:
        if source != self._source:
            self._enter(source)
        self._source_beats += 1
        if source != "safe":
            self._ramped, self._ramp_from = 0, action
        self._last = action
        return Chosen(action, source, self._observed_at)

    def _enter(self, source: str) -> None:
        if self._source:
            # Beats between two answers are held for a moment on every link.
            level = logging.WARNING
            if source in ("fresh", "held"):
                level = logging.DEBUG if self._source in ("fresh", "held") else logging.INFO
            LOGGER.log(level, "%s after %d beats %s", source, self._source_beats, self._source)
        self._source, self._source_beats = source, 0
        self.entries[source] += 1

    def _safe(self, observation: NDArray[np.float32]) -> Action:
        ramp = self._options.ramp
        if self._source != "safe":
            self._ramp_from = self._last
        self._ramped += 1
        if self._ramped <= ramp and isinstance(self._space, Box):
            share = self._ramped / ramp
            start = np.asarray(self._ramp_from, np.float32)
            goal = np.asarray(self._neutral, np.float32)
            return np.asarray(start + np.float32(share) * (goal - start), np.float32)
        if self._options.fallback is None:
            return self._neutral
        try:
            return self.fitted(self._options.fallback(observation))
        except Exception:
            self.fallback_failures += 1
            if self.fallback_failures == 1:
                LOGGER.exception("the fall-back of the robot failed; the neutral action is taken")
            return self._neutral

    def fitted(self, action: ActionLike) -> Action:
        """Returns an action of the space. ValueError if `action` has another shape or NaN."""
        if not isinstance(self._space, Box):
            return int(np.asarray(action))
        low, high = np.asarray(self._space.low), np.asarray(self._space.high)
        values = np.asarray(unmasked(action, "action"), np.float32)
        if values.shape != low.shape or not np.isfinite(values).all():
            raise ValueError(f"action: expected {low.size} finite values, received {action!r}")
        return np.asarray(np.clip(values, low, high), np.float32)
