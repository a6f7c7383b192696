"""`BeatLog`: the beats of the robot that the server does not have yet. Nothing here waits.

The robot's episodes are numbered and their beats too, so that nothing is lost and nothing is
counted twice, whatever the link does. An episode goes through these states, and never back:

    running    beats are added at the robot. The server is asked for decisions if it is the oldest.
    ended      the robot has ended it. The server still misses beats, or an older episode's end.
    complete   the server has acknowledged every beat; EndEpisode may be called, again and again.
    ending     its end is under way, on the stream; requests are of the episode after it.
    settled    the server has answered the end. The episode leaves the log.

The server's session is at the oldest episode, or at the one after it if the answer to the end of
the oldest one is under way or lost. So at most one end is under way: the server repeats the answer
to the last end only.
"""

from __future__ import annotations

import collections
import itertools
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spikeserve.trace_context import active_traceparent
from spikeserve.values import Action, EpisodeSummary, action_to_wire
from spikeserve.wire import METHODS, Message, message_class

MOST_EPISODES = 64  # whose ends the server may miss
MOST_SKIPPED = 65536  # rewards of one request
MOST_BYTES = 1 << 20  # of the history in one request


@dataclass
class Beat:
    """One beat. `executed` is None until the robot has executed its action."""

    observation: NDArray[np.float32]
    reward: float
    observed_at: int  # nanoseconds of time.monotonic_ns()
    executed: Action | None = None
    traceparent: str = field(default_factory=active_traceparent)
    message: Message | None = None  # as it travels in a history

    def to_wire(self, step: int) -> Message:
        """Returns the Beat of the wire contract."""
        if self.message is None or self.message.step != step:
            self.message = message_class("Beat")(
                step=step,
                observation=self.observation,
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

    def __post_init__(self) -> None:
        self.summary.set_running_or_notify_cancel()


class Episode:
    """The beats of one episode, from the first one that the server may miss."""

    def __init__(self, index: int, first_decision: int) -> None:
        self.index = index  # in the server's session
        self.first_decision = first_decision  # number of its first decision in the session
        self.first = 0  # step of beats[0]
        self.beats: collections.deque[Beat] = collections.deque()
        self.skipped: collections.deque[float] = collections.deque()  # of the steps before `first`
        self.acknowledged = 0  # the next step that the server expects
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
    def _begin(self) -> int:
        """Returns the step of the first beat in the next history."""
        return max(self.acknowledged - 1, self.first)

    def fits(self, most: int) -> bool:
        """Returns whether the server may miss at most as many beats as one history can have."""
        return self.steps - self._begin <= most

    def acknowledge(self, next_step: int, retained: int) -> None:
        """Notes that the server expects `next_step`. Keeps `retained` beats that it has.

        The executed action of the beat before `next_step` may still be missing there.
        """
        self.acknowledged = max(self.acknowledged, min(next_step, self.steps))
        self._forget(self.acknowledged - 1 - retained)

    def _forget(self, before: int) -> None:
        while self.beats and self.first < before:
            self.beats.popleft()
            self.first += 1
        while self.skipped and self.first - len(self.skipped) < before:
            self.skipped.popleft()

    def rewind(self, next_step: int) -> bool:
        """Notes that the server expects an older step. Returns False if its beats are not kept."""
        if not self.first - len(self.skipped) <= next_step <= self.steps:
            return False
        self.acknowledged = next_step
        return True

    def drop_oldest(self) -> None:
        """Keeps only the reward of the oldest beat."""
        self.skipped.append(self.beats.popleft().reward)
        self.first += 1

    def request(self, session_id: str, most: int) -> Message:
        """Returns the request for the newest beat, with the beats that the server may miss.

        If there are more than `most`, or the episode has ended, returns one that asks for no
        decision and carries the oldest of them.
        """
        begin = self._begin
        newest = self.steps - (1 if self.ending is None else 0)
        end = min(newest, begin + most)
        message = METHODS["Act"].request(
            session_id=session_id, step=end, decision=self.first_decision + end
        )
        offset = begin - self.first
        wanted = itertools.islice(self.beats, offset, offset + end - begin)
        message.history.extend([beat.to_wire(begin + i) for i, beat in enumerate(wanted)])
        if begin > self.acknowledged:
            missing = begin - self.acknowledged
            message.skipped_rewards.extend(list(self.skipped)[-missing:])
        if end < newest or self.ending is not None:
            return message
        beat = self.beats[-1]
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
        self._kept_beats = kept_beats
        self._bytes = 4 * observation_size + 64  # of a beat on the wire
        self.retained = 0  # beats that a server may lose again after it has acknowledged them
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
        kept = sum(len(episode.beats) for episode in self.episodes)
        for episode in self.episodes:
            while kept > self._kept_beats and len(episode.beats) > 1:
                episode.drop_oldest()
                self.dropped += 1
                kept -= 1
        return self.running.steps - 1

    def end(self, ending: Ending) -> None:
        """Ends the running episode. An episode without a beat has an empty summary at once."""
        if self.running.ending is not None or self.running.steps == 0:
            ending.summary.set_result(EpisodeSummary(0.0, 0, 0, 0.0))
            return
        self.running.ending = ending

    @property
    def is_too_long(self) -> bool:
        """Returns whether the server has missed so much that its session is given up."""
        return len(self.episodes) > MOST_EPISODES or any(
            len(episode.skipped) > MOST_SKIPPED for episode in self.episodes
        )

    def settle(self) -> Ending:
        """Removes the oldest episode, whose end was answered."""
        self.is_ending = False
        settled = self.episodes.popleft()
        assert settled.ending is not None
        if not self.episodes:
            decisions = settled.first_decision + settled.steps
            self.episodes.append(Episode(settled.index + 1, decisions))
        return settled.ending

    def begin_again(self) -> list[Ending]:
        """Moves to a new session. Returns the ends of the episodes that the old one had not ended.

        The running episode goes on with the beats that are kept, as the first ones of its episode.
        """
        endings = [episode.ending for episode in self.episodes if episode.ending is not None]
        running = Episode(0, 0)
        if self.running.ending is None:
            running.beats = self.running.beats
        self.is_ending = False
        self.lost_episodes += len(endings)
        self.episodes = collections.deque([running])
        return endings
