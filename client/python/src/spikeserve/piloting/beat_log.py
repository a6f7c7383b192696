"""`BeatLog`: the beats of the robot that the server may not have. Nothing here waits.

The robot's episodes are numbered and their beats too, so that nothing is lost and nothing is
counted twice, whatever the link does. An episode goes through these states, and never back:

    running    beats are added at the robot. The server is asked for decisions if it is the oldest.
    ended      the robot has ended it. The server still misses beats, or an older episode's end.
    complete   the server has acknowledged every beat; EndEpisode may be called, again and again.
    ending     its end is under way, on the stream; requests are of the episode after it.
    settled    the server has answered the end. The episode leaves the log once the store of the
               server has the end, too; a server that has lost it gets the episode again.

The server's session is at the oldest episode, or at the one after it if the answer to the end of
the oldest one is under way or lost. So at most one end is under way: the server repeats the answer
to the last end only. A history begins one beat before the one that the server expects, with what
was executed there, or the server's context starts behind a gap.
"""

from __future__ import annotations

import collections
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spikeserve.trace_context import active_traceparent
from spikeserve.values import Action, EpisodeSummary, action_to_wire
from spikeserve.wire import METHODS, Message, message_class

MOST_EPISODES = 4096  # whose ends the server may miss
MOST_SKIPPED = 65536  # rewards of one request
MOST_BYTES = 1 << 20  # of the history in one request
LEAST_BEATS = 3  # of an episode that are kept: one that the server has, and two that it may miss


@dataclass
class Beat:
    """One beat. `executed` is None until the robot has executed its action."""

    observation: NDArray[np.float32] | None  # None: the robot had no valid one
    reward: float
    observed_at: int  # of robot_clock.now_ns()
    executed: Action | None = None
    traceparent: str = field(default_factory=active_traceparent)
    message: Message | None = None  # as it travels in a history

    def to_wire(self, step: int) -> Message:
        """Returns the Beat of the wire contract."""
        if self.message is None or self.message.step != step:
            self.message = message_class("Beat")(
                step=step,
                observation=() if self.observation is None else self.observation,
                reward=self.reward,
                executed=action_to_wire(self.executed),
            )
        return self.message


@dataclass
class Ending:
    """How an episode has ended, and who waits for its summary, which cannot be cancelled."""

    reward: float
    terminated: bool
    truncated: bool
    target_return: float | None
    observation: NDArray[np.float32] | None
    summary: Future[EpisodeSummary] = field(default_factory=Future)

    # As in EpisodeSummary. The return is added in the order of the server.
    lost_steps: int = 0
    steps: int = 0
    episode_return: float = 0.0

    def __post_init__(self) -> None:
        self.summary.set_running_or_notify_cancel()

    def complete(self, summary: EpisodeSummary) -> None:
        """Gives the summary to those who wait for it."""
        own = {"steps": self.steps, "lost_steps": self.lost_steps}
        self.summary.set_result(replace(summary, episode_return=self.episode_return, **own))


class Episode:
    """The beats of one episode, from the first one that is kept."""

    def __init__(self, index: int, first_decision: int) -> None:
        self.index = index  # in the server's session
        self.first_decision = first_decision  # number of its first decision in the session
        self.first = 0  # step of beats[0]
        self.beats: collections.deque[Beat] = collections.deque()
        self.skipped: collections.deque[float] = collections.deque()  # of the steps before `first`
        self.acknowledged = 0  # the next step that the server expects
        self.lost_steps = 0  # before the first one, which only a lost session had
        self.rewards = 0.0  # sum for the steps behind the first one, which has no action before
        self.ending: Ending | None = None

    @property
    def steps(self) -> int:
        """Returns the number of beats of the episode."""
        return self.first + len(self.beats)

    @property
    def is_complete(self) -> bool:
        """Returns whether the server has all beats of an episode that has ended."""
        return self.ending is not None and self.acknowledged >= self.steps

    @property
    def past(self) -> int:
        """Returns the number of the first decision behind the episode."""
        return self.first_decision + self.steps

    @property
    def is_too_long(self) -> bool:
        """Returns whether rewards are gone that the server does not have."""
        return self.acknowledged < self.first - len(self.skipped)

    def _begin(self, most: int) -> int:
        """Returns the step of the first beat in the next history, of at most `most` beats.

        The server takes beats without an observation only with what follows them, so that a history
        of these alone would bring nothing. They count as rewards all the same.
        """
        newest = self.steps - (1 if self.ending is None else 0)
        begin = max(min(self.acknowledged, newest) - 1, self.first)
        if begin == self.acknowledged > 0:
            begin += 1  # the context starts behind what is not known
        if newest - begin <= most:
            return begin
        last = min(self.steps - 1, self.acknowledged + MOST_SKIPPED)
        seen = max(begin, self.acknowledged)
        while seen < last and self.beats[seen - self.first].observation is None:
            seen += 1
        return seen if seen > self.acknowledged else begin

    def fits(self, most: int) -> bool:
        """Returns whether the server may miss at most as many beats as one history can have."""
        return self.steps - self._begin(most) <= most

    def acknowledge(self, next_step: int) -> None:
        """Notes that the server expects `next_step`. All beats are kept for another session.

        The executed action of the beat before `next_step` may still be missing there.
        """
        before = self.acknowledged
        self.acknowledged = max(before, min(next_step, self.steps))
        for step in range(max(before - 1, self.first), self.acknowledged - 1):
            self.beats[step - self.first].message = None  # it is seldom sent again

    def rewind(self, next_step: int) -> bool:
        """Notes that the server expects an older step. Returns False if its beats are not kept."""
        if not self.first - len(self.skipped) <= next_step <= self.steps:
            return False
        self.acknowledged = next_step
        return True

    def drop_oldest(self) -> bool:
        """Keeps only the reward of the oldest beat. Returns whether the server misses the beat."""
        self.skipped.append(self.beats.popleft().reward)
        if len(self.skipped) > MOST_SKIPPED:
            self.skipped.popleft()
        self.first += 1
        return self.acknowledged < self.first

    def request(self, session_id: str, most: int) -> Message:
        """Returns the request for the newest beat, with the beats that the server may miss.

        If there are more than `most`, or the episode has ended, returns one that asks for no
        decision and carries the oldest of them.
        """
        begin = self._begin(most)
        newest = self.steps - (1 if self.ending is None else 0)
        end = min(newest, begin + most)
        message = METHODS["Act"].request(
            session_id=session_id, step=end, decision=self.first_decision + end
        )
        wanted = range(begin, end)
        message.history.extend([self.beats[i - self.first].to_wire(i) for i in wanted])
        if self.acknowledged < self.first:
            message.skipped_rewards.extend(list(self.skipped)[self.acknowledged - self.first :])
        blind = range(max(self.acknowledged, self.first), begin)
        message.skipped_rewards.extend([self.beats[i - self.first].reward for i in blind])
        beat = self.beats[-1]
        if end < newest or self.ending is not None or beat.observation is None:
            return message
        message.observation.extend(beat.observation.tolist())
        message.reward = beat.reward
        message.observed_at = beat.observed_at
        message.traceparent = beat.traceparent
        return message

    def end_request(self, session_id: str) -> Message:
        """Returns the EndEpisode of an episode that has ended."""
        ending = self.ending
        assert ending is not None and self.beats
        return METHODS["EndEpisode"].request(
            session_id=session_id,
            reward=ending.reward,
            terminated=ending.terminated,
            truncated=ending.truncated,
            target_return=ending.target_return,
            observation=() if ending.observation is None else ending.observation,
            executed_action=action_to_wire(self.beats[-1].executed),
            episode=self.index,
            steps=self.steps,
        )


class BeatLog:
    """The episodes that the server's session does not have completely. Not thread-safe."""

    def __init__(self, kept_beats: int, observation_size: int) -> None:
        self._kept_beats = kept_beats + 1  # and one that the server has
        self._bytes = 4 * observation_size + 64  # of a beat on the wire
        self.is_stored = False  # a store has the session, and may be behind its server
        self.settled: collections.deque[Episode] = collections.deque()  # the store may lack the end
        self.history_limit = 1024
        self.dropped = 0  # beats whose observations were not kept
        self.lost_episodes = 0
        self.is_ending = False  # the end of the oldest episode is under way, behind all its beats
        self.episodes: collections.deque[Episode] = collections.deque([Episode(0, 0)])

    @property
    def running(self) -> Episode:
        """Returns the episode of the robot's next beat."""
        return self.episodes[-1]

    @property
    def oldest(self) -> Episode:
        """Returns the first episode whose end the server has not answered."""
        return self.episodes[0]

    @property
    def is_current(self) -> bool:
        """Returns whether the next request is of the episode that the robot plays."""
        return len(self.episodes) == 1 + self.is_ending and self.running.ending is None

    @property
    def most(self) -> int:
        """Returns the most beats of one history."""
        return max(2, min(self.history_limit, MOST_BYTES // self._bytes))

    def add(self, beat: Beat) -> int:
        """Adds a beat. Returns its step."""
        if self.running.ending is not None:
            before = self.running
            self.episodes.append(Episode(before.index + 1, before.first_decision + before.steps))
        self.running.beats.append(beat)
        if self.running.steps > 1:
            self.running.rewards += beat.reward
        kept = sum(len(e.beats) for e in self.settled) + sum(len(e.beats) for e in self.episodes)
        for episode in (*self.settled, *self.episodes) if kept > self._kept_beats else ():
            while kept > self._kept_beats and len(episode.beats) > LEAST_BEATS:
                self.dropped += int(episode.drop_oldest())
                kept -= 1
        return self.running.steps - 1

    def end(self, ending: Ending) -> None:
        """Ends the running episode. An episode without a beat has an empty summary at once."""
        if self.running.ending is not None or self.running.steps == 0:
            ending.lost_steps = self.running.lost_steps
            ending.complete(EpisodeSummary(0.0, 0, 0, 0.0))
            return
        self.running.ending = ending

    @property
    def is_too_long(self) -> bool:
        """Returns whether the server has missed so much that its session is given up."""
        return len(self.episodes) > MOST_EPISODES or self.oldest.is_too_long

    def settle(self) -> Ending:
        """Notes that the end of the oldest episode was answered. Returns it."""
        self.is_ending = False
        settled = self.episodes.popleft()
        assert settled.ending is not None
        ending = settled.ending
        ending.lost_steps, ending.steps = settled.lost_steps, settled.steps
        ending.episode_return = settled.rewards + ending.reward
        if self.is_stored:
            settled.acknowledge(settled.steps)
            settled.ending = replace(ending, summary=Future())  # nobody waits for the next answer
            self.settled.append(settled)
            if len(self.settled) > MOST_EPISODES:
                self.settled.popleft()
        if not self.episodes:
            decisions = settled.first_decision + settled.steps
            self.episodes.append(Episode(settled.index + 1, decisions))
        return ending

    def forget_durable(self, decisions: int, episodes: int) -> None:
        """Notes that the store has so many decisions, and the ends of so many episodes.

        A server of an earlier release does not name the ends; they are in front of the decisions
        behind them.
        """
        while self.settled:
            oldest = self.settled[0]
            if oldest.index >= episodes and oldest.past >= decisions:
                break
            self.settled.popleft()

    def rewind(self, decision: int, episode: int | None) -> bool:
        """Notes that the server expects an older decision, which is of `episode` if that is known.

        Returns False if its beats are not kept.
        """
        while self.settled and (
            decision < self.oldest.first_decision
            or (episode is not None and episode < self.oldest.index)
        ):
            self.is_ending = False
            self.oldest.acknowledged = 0
            self.episodes.appendleft(self.settled.pop())
        return self.oldest.rewind(decision - self.oldest.first_decision)

    def begin_again(self, keeps_beats: bool = True) -> list[Ending]:
        """Moves to a new session. Returns the ends of the episodes that the old one had not ended.

        The running episode goes on with all of its beats, or with the next one if the server has
        refused them.
        """
        endings = [episode.ending for episode in self.episodes if episode.ending is not None]
        before, running = self.running, Episode(0, 0)
        if before.ending is None:
            known = before.first - len(before.skipped) if keeps_beats else before.steps
            if keeps_beats:
                running.beats, running.skipped = before.beats, before.skipped
                running.first = len(before.skipped)
                rewards = [*before.skipped, *(beat.reward for beat in before.beats)]
                for reward in rewards[1:]:
                    running.rewards += reward
            running.lost_steps = before.lost_steps + known
        self.is_ending = False
        self.lost_episodes += len(endings)
        self.episodes = collections.deque([running])
        self.settled.clear()
        return endings
