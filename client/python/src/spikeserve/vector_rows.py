"""Determines which rows of a vector environment end, which rows act, and with which inputs.

The blocking and the asyncio vector session share this module. Nothing in it sends or waits.

Gymnasium 1.x resets a row by itself after its episode has ended, in one of two modes:

* NEXT_STEP, the default: the step that ends an episode returns the final observation. The next
  step ignores the action of that row and returns the reset observation with reward 0. The row does
  not act in between. It gets an action that the environment ignores.
* SAME_STEP: the step that ends an episode returns the first observation of the next episode, and
  `infos["final_obs"]` holds the final observation. The row acts at once.

In both modes the ended episode gets its last reward, and no decision mixes two episodes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.batches import act_all
from spikeserve.caller import Caller
from spikeserve.calls import Call
from spikeserve.check import check, unmasked
from spikeserve.cursor import SessionCursor
from spikeserve.errors import SessionLostError
from spikeserve.replicas import Route, draw_id
from spikeserve.session_handle import AnySession
from spikeserve.spaces import (
    ActionSpace,
    Discrete,
    as_action_space,
    check_observation_space,
    stack_actions,
)
from spikeserve.values import Decision, EpisodeSummary, SessionOptions

_NEXT_STEP = "NextStep"  # the values of gymnasium.vector.AutoresetMode
_SAME_STEP = "SameStep"

# The actions of all rows, in the type of the environments: indices [rows], or values in environment
# units [rows, action size].
Actions = NDArray[Any]


@dataclass(frozen=True)
class VectorStep:
    """The calls of one step of the environments: first the endings, then the batch."""

    endings: dict[int, Call[EpisodeSummary]]  # by row
    rows: NDArray[np.int64]  # the rows that act; the other fields have one item for each of them
    cursors: list[SessionCursor]
    observations: list[NDArray[np.float32]]
    rewards: list[float]
    executed_actions: list[Any] | None

    def batch(self, timeout: float | None) -> Call[list[Decision]]:
        """Describes the decisions of all rows that act. Valid only after the endings."""
        return act_all(
            self.cursors, self.observations, self.rewards, timeout, self.executed_actions
        )


class VectorRows(Generic[AnySession]):
    """The rows of `envs`, a gymnasium.vector.VectorEnv, with one session each.

    `ended` holds the summary of each episode that the last `act` ended, by row. `decisions` holds
    the decision of each row at the last `act`; None: the row did not act.
    """

    def __init__(self, client: Caller, envs: Any) -> None:
        self._client = client
        self._num_envs = int(envs.num_envs)
        self._acts_on_ended_rows = _autoreset_mode(envs) == _SAME_STEP
        self._observation_space = envs.single_observation_space
        self._native_space = envs.single_action_space
        self._action_space: ActionSpace = as_action_space(self._native_space)
        self._sessions: list[AnySession] = []
        self._route = Route(draw_id())  # of all rows, so that one call reaches them
        self.decisions: list[Decision | None] = [None] * self._num_envs
        self.ended: dict[int, EpisodeSummary] = {}
        self._newly_ended: dict[int, EpisodeSummary] = {}

    @property
    def sessions(self) -> Sequence[AnySession]:
        """Returns the sessions in the order of the rows."""
        return self._sessions

    def _row_options(self, options: SessionOptions | None) -> Iterator[SessionOptions]:
        options = options or SessionOptions()
        for row in range(self._num_envs):
            yield replace(options, seed=options.seed + row)

    def _check_fits(self) -> None:
        policy = self._sessions[0].opening
        assert policy is not None
        size = policy.observation_size
        names = {feature.name for feature in policy.observation_features}
        if names and set(_names_of(self._observation_space)) == names:  # a Dict goes by its names
            return policy.check_action_space(self._action_space)
        check_observation_space(self._observation_space, size, policy.policy)
        policy.check_action_space(self._action_space)

    def _begin(
        self,
        observations: ArrayLike,
        rewards: ArrayLike | None,
        terminations: ArrayLike | None,
        truncations: ArrayLike | None,
        infos: dict[str, Any] | None,
        executed_actions: ArrayLike | None,
    ) -> VectorStep:
        observed = self._observed(observations)
        rewarded = self._rows("rewards", self._rewards(rewards), np.float64)
        terminated = self._rows("terminations", self._flags(terminations), np.bool_)
        truncated = self._rows("truncations", self._flags(truncations), np.bool_)
        executed = self._executed(executed_actions)
        over = terminated | truncated
        endings = {
            int(row): self._sessions[row].cursor.end_episode(
                rewarded[row],
                terminated[row],
                truncated[row],
                observation=self._final_observation(int(row), observed, infos),
                executed_action=None if executed is None else executed[row],
            )
            for row in np.flatnonzero(over)
            # A row at step 0 was ended before, by a call that failed later and is made again.
            if self._sessions[row].step > 0
        }
        rows = np.arange(self._num_envs)
        rows = rows if self._acts_on_ended_rows else rows[~over]
        return VectorStep(
            endings,
            rows,
            [self._sessions[row].cursor for row in rows],
            list(observed[rows]),
            rewarded[rows].tolist(),
            # A row whose episode ends in this step acts at step 0 next, which ignores the action.
            None if executed is None else list(executed[rows]),
        )

    def _observed(self, observations: ArrayLike) -> NDArray[Any]:
        """Returns one observation for each row: an array, or a dict of a Dict space."""
        if not isinstance(observations, Mapping):
            return self._rows("observations", observations, np.float32)
        rows = np.empty(self._num_envs, object)
        rows[:] = [row_of(observations, row) for row in range(self._num_envs)]
        return rows

    def _final_observation(
        self, row: int, observed: NDArray[Any], infos: dict[str, Any] | None
    ) -> Any:
        if not self._acts_on_ended_rows:
            return observed[row]
        # Simulators on a GPU do not keep them by default: then the last observation is unknown.
        finals = None if infos is None else infos.get("final_obs")
        present = True if infos is None else infos.get("_final_obs", np.ones(self._num_envs))[row]
        final = None if finals is None or not present else finals[row]
        return None if final is None else unmasked(final, "final_obs")

    def _finish(self, step: VectorStep, decisions: list[Decision]) -> Actions:
        by_row = dict(zip(step.rows.tolist(), decisions, strict=True))
        self.decisions = [by_row.get(row) for row in range(self._num_envs)]
        self.ended, self._newly_ended = self._newly_ended, {}
        actions = stack_actions(
            [None if decision is None else decision.action for decision in self.decisions],
            self._action_space,
        )
        return self._native_actions(actions)

    def _native_actions(self, actions: Actions) -> Actions:
        """Returns actions that the space of the environments contains."""
        if isinstance(self._action_space, Discrete) or self._native_space.dtype == np.float32:
            return actions
        from spikeserve.flat_spaces import to_native_box  # needs Gymnasium, as environments do

        return np.stack([to_native_box(action, self._native_space) for action in actions])

    async def _end(self, row: int, ending: Call[EpisodeSummary]) -> None:
        try:
            self._newly_ended[row] = await self._client.perform(ending)
        except SessionLostError as error:
            for session in self._lost_rows(error):
                await session._open_again()

    def _lost_rows(self, error: SessionLostError) -> list[AnySession]:
        """Returns the sessions that `error` is about. Raises it if they do not reopen."""
        lost = [session for session in self._sessions if session.session_id in error.session_ids]
        if not lost or not lost[0].reopens:
            raise error
        return lost

    def _truncations(self) -> list[Call[EpisodeSummary]]:
        """Describes the calls that end every running episode without a last reward."""
        cursors = [session.cursor for session in self._sessions if session.step > 0]
        return [cursor.end_episode(reward=0.0, truncated=True) for cursor in cursors]

    def _rewards(self, rewards: ArrayLike | None) -> ArrayLike:
        if rewards is not None:
            return rewards
        at_start = all(session.step == 0 for session in self._sessions)
        check(at_start, "rewards", "one for each row within an episode", None)
        return np.zeros(self._num_envs)

    def _flags(self, flags: ArrayLike | None) -> ArrayLike:
        return np.zeros(self._num_envs, np.bool_) if flags is None else flags

    def _executed(self, actions: ArrayLike | None) -> NDArray[Any] | None:
        if actions is None:
            return None
        executed = np.asarray(unmasked(actions, "executed_actions"))
        size = () if isinstance(self._action_space, Discrete) else (len(self._action_space.low),)
        expected = (self._num_envs, *size)
        check(executed.shape == expected, "executed_actions", f"shape {expected}", executed.shape)
        return executed

    def _rows(self, field: str, values: ArrayLike, dtype: Any) -> NDArray[Any]:
        """Returns `values` as an array with one row for each environment."""
        array = np.asarray(unmasked(values, field), dtype)
        dimensions = 2 if field == "observations" else 1
        fits = array.ndim == dimensions and len(array) == self._num_envs
        expected = f"shape ({self._num_envs},{' n' if dimensions == 2 else ''})"
        check(fits, field, expected, array.shape)
        return array


def _names_of(space: Any) -> tuple[str, ...]:
    """Returns the names of the numbers of a Dict space; () for other spaces."""
    if not hasattr(space, "keys"):
        return ()
    from spikeserve.flat_spaces import element_names  # needs Gymnasium, as environments do

    return element_names(space)


def row_of(observations: Mapping[str, Any], row: int) -> dict[str, Any]:
    """Returns one row of a Dict of batched arrays."""
    return {
        key: row_of(value, row) if isinstance(value, Mapping) else value[row]
        for key, value in observations.items()
    }


def _autoreset_mode(envs: Any) -> str:
    mode = envs.metadata.get("autoreset_mode", _NEXT_STEP)
    name = str(getattr(mode, "value", mode))
    known = (_NEXT_STEP, _SAME_STEP)
    check(name in known, "autoreset_mode", " or ".join(known), name)
    return name
