"""The parts of a pilot that wait for nothing: the fallback order, the log of beats, the doubt of a connection."""

import itertools
import time

import numpy as np
import pytest
import spikeserve
from spikeserve.distance import Arrivals, Distance, neutral_action
from spikeserve.lines import MISSES, SILENCE_SECONDS, Doubt
from spikeserve.piloting.beat_log import Beat, BeatLog, Ending
from spikeserve.piloting.fallback_order import FallbackOrder
from spikeserve.piloting.pilot_stats import Ages

BOX = spikeserve.Box((-2.0, -1.0), (2.0, 1.0))
OBSERVATION = np.zeros(3, np.float32)


def make_order(space=BOX, neutral=(0.0, 0.0), **options):
    options = spikeserve.PilotOptions(period=0.05, **options)
    fallback = FallbackOrder(options, space, neutral, began_at=0)
    fallback.begin_episode()
    return fallback


def choose(fallback, fresh=None, local=None):
    chosen = fallback.choose(None if fresh is None else (np.float32(fresh), 7), lambda: local, OBSERVATION, 9)
    return chosen.source, np.asarray(chosen.action).tolist(), chosen.observed_at


def test_the_rungs_follow_each_other():
    fallback = make_order(hold_beats=2, ramp_beats=4)
    assert choose(fallback) == ("safe", [0.0, 0.0], 0)
    assert choose(fallback, fresh=[1.0, 1.0]) == ("fresh", [1.0, 1.0], 7)
    assert [choose(fallback) for _ in range(2)] == [("held", [1.0, 1.0], 7)] * 2
    assert choose(fallback, local=np.float32([0.8, -0.4])) == ("local", [np.float32(0.8), np.float32(-0.4)], 9)
    ramp = [choose(fallback)[1] for _ in range(6)]
    assert np.allclose(ramp, np.outer([0.75, 0.5, 0.25, 0, 0, 0], [0.8, -0.4]))
    assert choose(fallback, local=np.float32([0.5, 0.5]))[0] == "local"
    assert choose(fallback, fresh=[1.0, 0.0])[0] == "fresh"
    assert fallback.entries == {"fresh": 2, "held": 1, "local": 2, "safe": 2}


def test_a_held_action_is_what_the_robot_executed():
    fallback = make_order()
    choose(fallback, fresh=[1.0, 1.0])
    fallback.executed(np.float32([0.5, 0.25]))
    assert choose(fallback) == ("held", [0.5, 0.25], 7)


def test_nothing_is_held_over_the_end_of_an_episode():
    fallback = make_order()
    choose(fallback, fresh=[1.0, 1.0])
    fallback.begin_episode()
    assert choose(fallback)[:2] == ("safe", [0.0, 0.0])


def test_the_fall_back_of_the_robot_follows_the_ramp():
    answers = iter([[9.0, 0.5], "wrong", [1.0], [0.25, 0.25]])
    fallback = make_order(hold_beats=0, ramp_beats=1, neutral=(0.5, 0.0), fallback=lambda _: next(answers))
    choose(fallback, fresh=[1.0, 1.0])
    actions = [choose(fallback)[1] for _ in range(5)]
    assert actions == [[0.5, 0.0], [2.0, 0.5], [0.5, 0.0], [0.5, 0.0], [0.25, 0.25]]
    assert fallback.fallback_failures == 2


def test_an_action_is_not_held_for_longer_than_its_beats_take():
    """A robot's computer that was suspended has an old action, and few beats since."""
    fallback = make_order(hold_beats=2, max_age=1.0)
    choose(fallback, fresh=[1.0, 1.0])
    limit = 7 + int(1.1e9)  # max_age and two periods after the observation
    assert fallback.choose(None, lambda: None, OBSERVATION, limit).source == "held"
    assert fallback.choose(None, lambda: None, OBSERVATION, limit + 1).source == "safe"


def test_an_index_has_no_ramp():
    fallback = make_order(spikeserve.Discrete(3), neutral=2, hold_beats=1)
    assert choose(fallback) == ("safe", 2, 0)
    fallback.choose((1, 7), lambda: None, OBSERVATION, 9)
    assert [choose(fallback)[:2] for _ in range(2)] == [("held", 1), ("safe", 2)]


class Robot:
    """Adds beats to a log, and does with its requests what the server does."""

    def __init__(self, kept=100, size=3, is_stored=False):
        self.log = BeatLog(kept, size)
        self.log.is_stored = is_stored
        self.numbers = itertools.count()
        self.session = []  # (observation, reward) of the running episode at the server
        self.rewards = []

    def beat(self, sees=True):
        n = next(self.numbers)
        beats = self.log.running.beats
        if beats and self.log.running.ending is None:
            beats[-1].executed = np.float32([n])
        self.log.add(Beat(np.full(3, n, np.float32) if sees else None, float(n), n))

    def end(self):
        self.log.running.beats[-1].executed = np.float32([-1])
        ending = Ending(1.0, True, False, None, None)
        self.log.end(ending)
        return ending

    def ask(self):
        """Sends the request of the oldest episode. Returns whether it asks for a decision."""
        episode = self.log.oldest
        request = episode.request("id", self.log.most)
        assert request.decision == episode.first_decision + request.step
        begin = request.step - len(request.history)
        assert begin - len(request.skipped_rewards) <= len(self.session)
        if self.session and request.step > len(self.session) and not request.skipped_rewards:
            assert begin < len(self.session)  # with what was executed there, which a store may have lost
        for reward in request.skipped_rewards[len(self.session) - begin :] if begin > len(self.session) else ():
            self.session.append((None, reward))
        for beat in request.history:
            assert beat.HasField("executed")
            if beat.step >= len(self.session):
                assert beat.step == len(self.session)
                self.session.append((beat.observation[0] if beat.observation else None, beat.reward))
        if request.observation:
            self.session.append((request.observation[0], request.reward))
        episode.acknowledge(len(self.session))
        return bool(request.observation)


def test_every_beat_travels_once():
    robot = Robot()
    for asks in [True, False, False, True, False, True, True, False]:
        robot.beat()
        if asks:
            assert robot.ask()
    ending = robot.end()
    assert not robot.log.oldest.is_complete
    assert not robot.ask()
    assert robot.log.oldest.is_complete
    assert robot.session == [(n, n) for n in range(8)]
    assert robot.log.oldest.end_request("id").steps == 8
    assert robot.log.settle() is ending
    assert robot.log.is_current and robot.log.running.index == 1 and robot.log.running.first_decision == 8


def test_the_next_episode_is_asked_for_while_the_end_is_under_way():
    robot = Robot()
    for _ in range(3):
        robot.beat()
    robot.end()
    log = robot.log
    assert log.oldest.fits(3) and not log.oldest.fits(2)
    log.is_ending = True
    assert not log.is_current  # the robot has not begun it
    robot.beat()
    assert log.is_current
    request = log.running.request("id", log.most)
    assert (request.step, request.decision, len(request.history)) == (0, 3, 0)
    robot.end()
    robot.beat()
    assert not log.is_current  # two ends are never under way
    log.settle()
    assert not log.is_ending and not log.is_current


def test_a_long_history_travels_in_parts():
    robot = Robot(kept=1000)
    robot.log.history_limit = 100
    for _ in range(250):
        robot.beat()
    assert [robot.ask() for _ in range(3)] == [False, False, True]
    assert robot.session == [(n, n) for n in range(250)]
    wide = BeatLog(1000, 100_000)
    assert wide.most == 2


def test_of_beats_that_are_not_kept_the_rewards_travel():
    robot = Robot(kept=10)
    for _ in range(30):
        robot.beat()
    assert robot.log.dropped == 19
    assert robot.ask()
    assert robot.session == [(None, n) for n in range(19)] + [(n, n) for n in range(19, 30)]


@pytest.mark.parametrize("kept", [2, 3, 5, 100])
def test_a_server_that_lost_beats_is_told_what_was_executed_before_them(kept):
    """Or its context starts behind the step that it expects."""
    for known, ends in itertools.product(range(12), (False, True)):
        robot = Robot(kept)
        for _ in range(12):
            robot.beat()
            robot.ask()
        del robot.session[known:]
        assert robot.log.rewind(known, None)
        if ends:
            robot.end()
        robot.beat()
        assert robot.ask() == (not ends)
        assert len(robot.session) == 13 - ends
        assert kept < 100 or robot.session == [(n, n) for n in range(13 - ends)]


def test_a_server_that_lost_beats_gets_them_again():
    robot = Robot()
    for _ in range(20):
        robot.beat()
        robot.ask()
    del robot.session[16:]
    assert robot.log.rewind(16, None)
    robot.beat()
    robot.ask()
    assert robot.session == [(n, n) for n in range(21)]
    assert robot.log.rewind(3, 0)
    assert not robot.log.rewind(22, None)


def test_a_request_sent_again_tells_what_was_executed_before():
    """Its first answer may be that of a server that has died since."""
    robot = Robot()
    for _ in range(3):
        robot.beat()
    assert robot.ask()
    request = robot.log.oldest.request("id", robot.log.most)
    assert (request.step, len(request.history)) == (2, 1)


def test_a_step_without_an_observation_is_sent_as_one():
    robot = Robot()
    for sees in (True, True, False, False):
        robot.beat(sees)
        assert robot.ask() == sees
    robot.end()
    assert not robot.ask()
    assert robot.session == [(0, 0), (1, 1), (None, 2), (None, 3)]


def test_more_blind_steps_than_a_history_has_count_as_rewards():
    robot = Robot(kept=1000)
    robot.log.history_limit = 10
    robot.beat()
    assert robot.ask()
    for _ in range(50):
        robot.beat(sees=False)
    robot.beat()
    assert robot.ask()
    assert robot.session == [(0, 0)] + [(None, n) for n in range(1, 51)] + [(51, 51)]
    for _ in range(50):
        robot.beat(sees=False)
    robot.end()
    assert not robot.ask()
    assert robot.session[52:] == [(None, n) for n in range(52, 102)]


def end_and_settle(robot, beats):
    """Plays an episode that the server answers wholly."""
    for _ in range(beats):
        robot.beat()
    ending = robot.end()
    robot.ask()
    assert robot.log.settle() is ending
    robot.session = []
    ending.complete(spikeserve.EpisodeSummary(0.0, beats, 0, 0.0))


def test_the_end_of_an_episode_is_kept_until_the_store_has_it():
    robot = Robot(is_stored=True)
    for beats in (3, 2, 4):
        end_and_settle(robot, beats)
    robot.beat()
    assert robot.ask()
    log = robot.log
    assert [e.index for e in log.settled] == [0, 1, 2]
    log.forget_durable(decisions=3, episodes=1)
    assert [e.index for e in log.settled] == [1, 2]
    log.forget_durable(decisions=6, episodes=0)  # an older server: a decision behind the second end
    assert [e.index for e in log.settled] == [2]
    # The server has lost the last end, and two beats before it.
    assert log.rewind(7, 2)
    assert [e.index for e in log.episodes] == [2, 3] and not log.settled
    robot.session = [(5, 5), (6, 6)]
    assert not robot.ask()
    assert robot.session == [(n, n) for n in range(5, 9)]
    assert log.oldest.is_complete and log.oldest.end_request("id").steps == 4
    log.settle().complete(spikeserve.EpisodeSummary(0.0, 4, 0, 0.0))  # nobody waits for it
    robot.session = []
    assert robot.ask() and robot.session == [(9, 9)]
    # It has lost the end alone: the decision that it expects is the same.
    assert log.rewind(9, 2) and log.oldest.index == 2 and log.oldest.is_complete


def test_a_session_that_no_store_has_keeps_no_ended_episode():
    robot = Robot()
    end_and_settle(robot, 3)
    assert not robot.log.settled


def test_a_new_session_has_the_whole_running_episode():
    """As far as its beats are kept; of older ones, their rewards. What is missing is counted."""
    robot = Robot(kept=10)
    for _ in range(30):
        robot.beat()
        robot.ask()
    assert robot.log.dropped == 0
    robot.session = []
    assert robot.log.begin_again() == []
    robot.beat()
    assert robot.ask()
    assert robot.session == [(None, n) for n in range(20)] + [(n, n) for n in range(20, 31)]
    assert robot.log.running.lost_steps == 0
    # Beats that the server has refused are not sent to the next session.
    assert robot.log.begin_again(keeps_beats=False) == []
    robot.session = []
    robot.beat()
    assert robot.ask() and robot.session == [(31, 31)]
    ending = robot.end()
    robot.ask()
    robot.log.settle().complete(spikeserve.EpisodeSummary(0.0, 1, 0, 0.0))
    assert ending.summary.result(0).lost_steps == 31


def test_episodes_wait_for_the_end_of_older_ones():
    robot = Robot()
    endings = []
    for _ in range(3):
        robot.beat()
        robot.beat()
        endings.append(robot.end())
    robot.beat()
    assert [episode.index for episode in robot.log.episodes] == [0, 1, 2, 3]
    assert not robot.log.is_current
    for ending in endings:
        robot.session = []
        assert not robot.ask()
        assert robot.log.settle() is ending
    robot.session = []
    assert robot.log.is_current and robot.ask()
    assert robot.log.running.first_decision == 6


def test_a_new_session_goes_on_with_the_beats_that_are_kept():
    robot = Robot()
    robot.beat()
    ending = robot.end()
    for _ in range(5):
        robot.beat()
    assert robot.log.begin_again() == [ending]
    assert robot.ask()
    assert [observation for observation, _ in robot.session] == [1, 2, 3, 4, 5]
    assert robot.log.lost_episodes == 1


def test_an_episode_without_a_beat_has_an_empty_summary():
    log = BeatLog(10, 3)
    ending = Ending(1.0, True, False, None, None)
    log.end(ending)
    assert ending.summary.result(0).steps == 0


def test_a_race_begins_after_a_silence_and_some_misses():
    doubt = Doubt()
    now = time.monotonic()
    long_ago = now - 2 * SILENCE_SECONDS
    assert not doubt.waits(now)
    assert not any(doubt.missed(long_ago) for _ in range(MISSES - 1))
    assert doubt.missed(long_ago)
    assert not doubt.missed(long_ago)  # while the race is on
    doubt.raced(fresh_won=False)
    assert not doubt.waits(long_ago)  # in the pause after it
    doubt.answered()
    assert not any(doubt.missed(long_ago) for _ in range(MISSES))  # they began before the answer


def test_percentiles_are_exact_to_two_percent():
    ages = Ages()
    assert ages.quantile(0.5) == 0.0
    for i in range(1, 1001):
        ages.add(i / 1000)
    for share in (0.5, 0.99, 0.999):
        assert ages.quantile(share) == pytest.approx(share, rel=0.02)
    ages.add(1e9)
    assert ages.quantile(1.0) > 3000


def test_decisions_of_a_far_server_arrive_later():
    arrivals = Arrivals(Distance(delay=2), spikeserve.Discrete(9), seed=0)
    assert [arrivals.executed(beat, beat + 1) for beat in range(6)] == [0, 0, 1, 2, 3, 4]
    late = Arrivals(Distance(delay=1, jitter=3, loss=0.3), spikeserve.Discrete(99), seed=0)
    executed = [late.executed(beat, beat + 1) for beat in range(60)]
    assert executed == sorted(executed)  # an older decision never follows a newer one
    assert all(action <= beat for beat, action in enumerate(executed))
    assert executed[-1] > 50
    assert neutral_action(spikeserve.Box((-1.0, 2.0), (1.0, 4.0))).tolist() == [0.0, 3.0]


@pytest.mark.parametrize("options", [{"delay": -1}, {"jitter": -1}, {"loss": 1.0}])
def test_a_distance_is_checked(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))}: expected "):
        Distance(**options)
