"""`Pilot`: every beat of a robot has an action, whatever the link does."""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.connection import Connection
from spikeserve.piloting import robot_clock
from spikeserve.piloting.beat_log import Beat, Ending
from spikeserve.piloting.fallback_order import Chosen, FallbackOrder
from spikeserve.piloting.link import Link
from spikeserve.piloting.pilot_options import PilotAction, PilotOptions
from spikeserve.piloting.pilot_stats import PilotStats
from spikeserve.piloting.server_session import ServerSession
from spikeserve.piloting.sight import observation_of
from spikeserve.values import Action, ActionLike, EpisodeSummary

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

LOGGER = logging.getLogger("spikeserve.pilot")


class Pilot:
    """Flies one robot: returns an action for each beat in time, fresh from the server if possible.

        with Client(address) as client, Pilot(client, "pendulum", period=0.02) as pilot:
            action = pilot.beat(observation, reward)

    The further arguments are the fields of PilotOptions. The constructor opens the session and
    waits for the server, and raises SpikeserveError; `beat` never waits longer than the budget, and
    raises only before its first valid observation. A background thread brings the server all beats,
    in order and once, whoever chose their actions: the server's session is that of the robot.
    Answers that come too late are not executed, and neither are those from before a reconnection.

    For one thread; `stats` may be called from any.
    """

    def __init__(self, client: Connection, policy: str, period: float, **options: Any) -> None:
        self._options = PilotOptions(period=period, **options)
        self._session = ServerSession(client, policy, self._options)
        opening = self._session.opening
        self._order = self._session.order
        neutral = self._order.executed(self._options.neutral)
        if neutral is None:
            wire = self._session.neutral
            is_discrete = wire.WhichOneof("kind") != "continuous"
            neutral = wire.discrete if is_discrete else list(wire.continuous.values)
        self._no_observation = np.full(opening.observation_size, np.nan, np.float32)
        self._has_seen = False  # whether there was a valid observation
        self._last_invalid = ""  # what was wrong with the last one that was not
        began_at = robot_clock.now_ns()
        order_options = self._options
        if order_options.fallback is not None:
            fallback = self._order.around(order_options.fallback)
            order_options = replace(order_options, fallback=fallback)
        self._fallback = FallbackOrder(order_options, opening.action_space, neutral, began_at)
        self._fallback.begin_episode()
        self._link = Link(client, self._options, self._session)
        self._executed_step = -1  # of `_executed_in`: the newest answer that was executed
        self._executed_in = self._link.log.running
        self._is_miswired = False  # says the newest answer
        self._beats = 0
        self._is_new_episode = True
        self._ending: Ending | None = None  # of the episode before
        self._last_executed: Action | None = None
        self._logged: set[str] = set()
        self._link.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def session_id(self) -> str:
        """Returns the id of the session at the server."""
        return self._session.session_id

    def beat(
        self,
        observation: ArrayLike,
        reward: float = 0.0,
        *,
        executed_action: ActionLike | None = None,
    ) -> PilotAction:
        """Returns the action for an observation, at most `budget` seconds later.

        `reward` is for the action of the beat before; the first beat of an episode ignores it.
        `executed_action` is what the robot executed in the beat before, if it differs from the
        returned action, for example because a safety layer clipped it.

        Raises ValueError as long as no observation was valid: the robot is not wired right. Later,
        a beat whose observation has another size, or a number that is not finite, has a held or a
        safe action, and nothing raises.
        """
        began = time.monotonic()
        seen, wrong = observation_of(observation, self._no_observation.size, self._order)
        if seen is None and not self._has_seen:
            raise ValueError(wrong)
        self._has_seen = True
        try:
            return self._beat(seen, wrong, reward, executed_action, began)
        except Exception:
            self._complain("beat", "the pilot failed; the neutral action is taken", exc_info=True)
            with self._link.changed:
                self._link.counters.count(failures=1)
            self._beats += 1
            neutral = self._order.action(self._fallback.neutral)
            return PilotAction(neutral, "safe", 0.0, self._beats - 1)

    def end_episode(
        self,
        reward: float,
        terminated: bool = False,
        truncated: bool = False,
        target_return: float | None = None,
        observation: ArrayLike | None = None,
        *,
        executed_action: ActionLike | None = None,
    ) -> Future[EpisodeSummary]:
        """Ends the episode; the next beat begins another one. Never waits, and never raises.

        The arguments are those of Session.end_episode. The result of the future is the summary of
        the server, once it has all beats of the episode. Its exception is SpikeserveError if the
        session was lost, or the pilot closed before.
        """
        with self._link.changed:
            self._note_executed(executed_action)
            last = None if observation is None else self._last_observation(observation)
            target = None if target_return is None else self._finite("target_return", target_return)
            ending = Ending(self._number(reward), bool(terminated), bool(truncated), target, last)
            if self._is_new_episode:  # it has no beat
                ending.complete(EpisodeSummary(0.0, 0, 0, 0.0))
                return ending.summary
            self._link.end_episode(ending)
        self._ending, self._is_new_episode, self._executed_step = ending, True, -1
        self._fallback.begin_episode()
        return ending.summary

    def wait_ready(self, timeout: float) -> bool:
        """Waits for an answer that the next beat may execute, for at most `timeout` seconds.

        Returns whether there is one. The first beats of an episode have none on a slow link; a
        robot that stands still calls this after its first beat. An answer that is older than
        `max_age` then is not executed all the same.
        """
        link, ends = self._link, time.monotonic() + timeout
        with link.changed:
            while not self._has_answer():
                left = ends - time.monotonic()
                if left <= 0:
                    return False
                # No beat asks meanwhile: the stream may have opened, or broken, after the last one.
                if link.log.running.beats and not link.is_asking:
                    link.send_newest()
                link.changed.wait(min(left, 0.05))
        return True

    def stats(self) -> PilotStats:
        """Returns what the pilot has done so far."""
        with self._link.changed:
            return self._link.counters.snapshot(
                entries=dict(self._fallback.entries),
                dropped=self._link.log.dropped,
                lost_episodes=self._link.log.lost_episodes,
                last_invalid_observation=self._last_invalid,
                has_local=self._session.has_local,
                local_head_is_copy=self._session.has_local and self._session.shares_head,
            )

    def close(self) -> None:
        """Waits until the server has the ends of all episodes, then closes the session.

        Waits for at most `close_timeout` seconds. Futures of episodes whose end the server does not
        have then fail.
        """
        self._link.close(self._options.close_timeout)

    def _beat(
        self,
        observation: NDArray[np.float32] | None,
        wrong: str,
        reward: float,
        executed: ActionLike | None,
        began: float,
    ) -> PilotAction:
        link, now_ns = self._link, robot_clock.now_ns()
        with link.changed:
            self._note_executed(executed)
            if observation is None:
                self._last_invalid = wrong
                link.counters.count(invalid_observations=1)
                self._not_valid("observation", wrong)
            earned = 0.0 if self._is_new_episode else self._number(reward)
            step = link.log.add(Beat(observation, earned, now_ns))
            episode = link.log.running
            if self._session.local is not None:
                position = (episode.index, step)
                before, ending = self._last_executed, self._ending
                self._session.local.add(observation, earned, before, position, ending)
                link.changed.notify_all()
            self._is_new_episode, self._ending = False, None
            link.send_newest()
            fresh = None
            if observation is not None:
                fresh = self._await_answer(began + self._options.wait)
        if observation is None:  # nothing is decided without one
            chosen = self._fallback.choose(None, lambda: None, self._no_observation, now_ns)
        else:
            chosen = self._fallback.choose(
                fresh, self._ask_local, observation, now_ns, self._is_miswired
            )
        with link.changed:
            age = max(0.0, (robot_clock.now_ns() - chosen.observed_at) / 1e9)
            self._log_executed(chosen.action)
            link.counters.beat(chosen.source, age, time.monotonic())
        self._beats += 1
        return self._action(chosen, age)

    def _await_answer(self, deadline: float) -> tuple[Action, int] | None:
        """Returns the newest answer that was not executed and is not stale, and its time.

        Waits for a newer answer if it should arrive in time.
        """
        link = self._link
        while True:
            answer, wanted = link.answer, link.expected_answer(deadline)
            if answer is not None and answer.episode is not link.log.running:
                answer = None
            step = -1 if answer is None else answer.step
            left = deadline - time.monotonic()
            if wanted is None or wanted <= step or left <= 0:
                break
            link.changed.wait(left)
        if answer is None or not self._has_answer():
            return None
        self._executed_in = answer.episode
        self._is_miswired = answer.is_miswired
        if robot_clock.now_ns() - answer.observed_at > self._options.oldest * 1e9:
            link.counters.count(stale=1)
            self._executed_step = answer.step
            return None
        self._executed_step = answer.step
        return answer.action, answer.observed_at

    def _has_answer(self) -> bool:
        """Returns whether there is an answer for the running episode that was not executed."""
        answer, running = self._link.answer, self._link.log.running
        executed = self._executed_step if self._executed_in is running else -1
        return answer is not None and answer.episode is running and answer.step > executed

    def _ask_local(self) -> Action | None:
        local = self._session.local
        return None if local is None else local.catch_up()

    def _action(self, chosen: Chosen, age: float) -> PilotAction:
        action = self._order.action(chosen.action)
        copy = action if isinstance(action, int) else np.array(action)  # the caller may change it
        return PilotAction(copy, chosen.source, age, self._beats - 1)

    def _log_executed(self, action: Action) -> None:
        self._last_executed = action
        beats = self._link.log.running.beats
        if beats:
            beats[-1].executed, beats[-1].message = action, None

    def _note_executed(self, executed: ActionLike | None) -> None:
        if executed is None or self._is_new_episode:
            return
        try:
            action = self._fallback.fitted(self._order.executed(executed))
        except (TypeError, ValueError) as error:
            self._not_valid("executed_action", f"executed_action: {error}")
            return
        self._fallback.executed(action)
        self._log_executed(action)

    def _last_observation(self, given: ArrayLike) -> NDArray[np.float32] | None:
        """Returns the observation behind an episode, which is only recorded; None: not valid."""
        observation, wrong = observation_of(given, self._no_observation.size, self._order)
        if observation is None:
            self._not_valid("observation", wrong)
        return observation

    def _number(self, reward: float) -> float:
        return self._finite("reward", reward) or 0.0

    def _finite(self, field: str, given: float) -> float | None:
        """Returns a finite number, or None in the place of anything else."""
        try:
            number = float(given)
        except (TypeError, ValueError):
            number = float("nan")
        if np.isfinite(number):
            return number
        self._not_valid(field, f"{field}: expected a finite number, received {given!r}")
        return None

    def _not_valid(self, field: str, message: str) -> None:
        self._link.counters.count(invalid=1)
        self._complain(field, message)

    def _complain(self, kind: str, message: str, exc_info: bool = False) -> None:
        if kind not in self._logged:
            self._logged.add(kind)
            LOGGER.error("%s (reported once)", message, exc_info=exc_info)
