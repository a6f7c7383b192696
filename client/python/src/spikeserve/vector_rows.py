"""What the blocking and the asyncio vector session share: which rows end, which act, and with what.

Nothing here waits or sends.

Gymnasium 1.x resets an ended row by itself, in one of two ways:

* NEXT_STEP, its default: the step that ends an episode returns the final observation, and the next
  step ignores the row's action and returns the reset observation with reward 0. So the ended row
  is not acted on: it gets an action that nobody reads.
* SAME_STEP: the step that ends an episode returns the next episode's first observation already
  (the final one is in `infos["final_obs"]`), so the row is acted on at once.

Either way the ended episode gets its last reward, and no decision ever mixes two episodes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.calls import SessionCursor
from spikeserve.errors import SpikeserveError
from spikeserve.spaces import ActionSpace, as_action_space, stack_actions
from spikeserve.values import Decision, EpisodeSummary, Opening, SessionOptions

_NEXT_STEP = "NextStep"  # the values of gymnasium.vector.AutoresetMode
_SAME_STEP = "SameStep"


@dataclass(frozen=True)
class Ending:
    """How a row's episode ended: arguments of end_episode."""

    row: int
    reward: float
    terminated: bool
    truncated: bool
    observation: NDArray[np.float32] | None


@dataclass(frozen=True)
class VectorStep:
    """What one step of the environments asks for: first these endings, then these decisions."""

    endings: list[Ending]
    rows: NDArray[np.int64]  # those that act, and their
    cursors: list[SessionCursor]
    observations: list[NDArray[np.float32]]
    rewards: list[float]


class VectorRows:
    """The rows of `envs`, a gymnasium.vector.VectorEnv, each with a session.

    `ended` holds the summary of each episode that the last `act` ended, by row; `decisions` the
    last decision of each row, None where it was not acted on.
    """

    def __init__(self, envs: Any) -> None:
        self._num_envs = int(envs.num_envs)
        self._acts_on_ended_rows = _autoreset_mode(envs) == _SAME_STEP
        self._observation_shape = tuple(envs.single_observation_space.shape)
        self._action_space: ActionSpace = as_action_space(envs.single_action_space)
        self._cursors: list[SessionCursor] = []
        self.decisions: list[Decision | None] = [None] * self._num_envs
        self.ended: dict[int, EpisodeSummary] = {}
        self._newly_ended: dict[int, EpisodeSummary] = {}

    def _row_options(self, options: SessionOptions | None) -> Iterator[SessionOptions]:
        """What each row's session is opened with."""
        options = options or SessionOptions()
        for row in range(self._num_envs):
            yield replace(options, seed=options.seed + row)

    def _check_fits(self, policy: Opening | None) -> None:
        assert policy is not None
        if self._observation_shape != (policy.observation_size,):
            raise ValueError(
                f"observation space: policy {policy.policy!r} takes shape "
                f"({policy.observation_size},), the environment has {self._observation_shape}"
            )
        if self._action_space != policy.action_space:
            raise ValueError(
                f"action space: policy {policy.policy!r} has {policy.action_space}, "
                f"the environment has {self._action_space}"
            )

    def _begin(
        self,
        observations: ArrayLike,
        rewards: ArrayLike | None,
        terminations: ArrayLike | None,
        truncations: ArrayLike | None,
        infos: dict[str, Any] | None,
    ) -> VectorStep:
        observed = self._rows("observations", observations, np.float32)
        rewarded = self._rows("rewards", self._rewards(rewards), np.float64)
        terminated = self._rows("terminations", self._flags(terminations), np.bool_)
        truncated = self._rows("truncations", self._flags(truncations), np.bool_)
        over = terminated | truncated
        endings = [
            Ending(
                int(row),
                float(rewarded[row]),
                bool(terminated[row]),
                bool(truncated[row]),
                self._final_observation(int(row), observed, infos),
            )
            for row in np.flatnonzero(over)
            # The others were ended by a call that failed later on, and was made again.
            if self._cursors[row].step > 0
        ]
        rows = np.arange(self._num_envs)
        rows = rows if self._acts_on_ended_rows else rows[~over]
        return VectorStep(
            endings,
            rows,
            [self._cursors[row] for row in rows],
            list(observed[rows]),
            rewarded[rows].tolist(),
        )

    def _final_observation(
        self, row: int, observed: NDArray[np.float32], infos: dict[str, Any] | None
    ) -> NDArray[np.float32] | None:
        if not self._acts_on_ended_rows:
            return np.asarray(observed[row], np.float32)
        final = None if infos is None else infos["final_obs"][row]
        return None if final is None else np.asarray(final, np.float32)

    def _finish(
        self, step: VectorStep, results: Sequence[Any]
    ) -> NDArray[np.int64] | NDArray[np.float32]:
        """All rows move on or, if any failed, none does."""
        for cursor, result in zip(step.cursors, results, strict=True):
            if isinstance(result, SpikeserveError):
                raise result
            cursor.check(result)
        decisions: list[Decision | None] = [None] * self._num_envs
        for row, cursor, result in zip(step.rows, step.cursors, results, strict=True):
            decisions[row] = cursor.accept(result)
        self.decisions = decisions
        self.ended, self._newly_ended = self._newly_ended, {}
        return stack_actions(
            [None if decision is None else decision.action for decision in decisions],
            self._action_space,
        )

    def _rewards(self, rewards: ArrayLike | None) -> ArrayLike:
        if rewards is not None:
            return rewards
        if any(cursor.step > 0 for cursor in self._cursors):
            raise ValueError("rewards: expected one a row within an episode, got None")
        return np.zeros(self._num_envs)

    def _flags(self, flags: ArrayLike | None) -> ArrayLike:
        return np.zeros(self._num_envs, np.bool_) if flags is None else flags

    def _rows(self, field: str, values: ArrayLike, dtype: Any) -> NDArray[Any]:
        """`values` as an array of one row an environment."""
        array = np.asarray(values, dtype)
        dimensions = 2 if field == "observations" else 1
        if array.ndim != dimensions or len(array) != self._num_envs:
            expected = f"({self._num_envs},{' n' if dimensions == 2 else ''})"
            raise ValueError(f"{field}: expected shape {expected}, got {array.shape}")
        return array


def _autoreset_mode(envs: Any) -> str:
    mode = envs.metadata.get("autoreset_mode", _NEXT_STEP)
    name = str(getattr(mode, "value", mode))
    if name not in (_NEXT_STEP, _SAME_STEP):
        raise ValueError(f"autoreset_mode: expected {_NEXT_STEP} or {_SAME_STEP}, got {name}")
    return name
