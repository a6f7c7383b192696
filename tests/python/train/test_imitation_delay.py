"""`imitate --delay`: what is imitated, remembered and executed when a decision takes effect some steps later."""

import json
import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from spikeserve.imitation.actors import Bursts, DelayedStudentActor
from spikeserve.imitation.datasets import read_dataset
from spikeserve.imitation.delays import Delays, label_after, label_all_after, parse_delay
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import Episode, play
from spikeserve.imitation.options import ImitationOptions
from spikeserve.imitation.pipeline import imitate
from serving import run


@pytest.mark.parametrize(
    ("value", "ends"), [("0", (0, 0)), ("3", (3, 3)), (" 0..5 ", (0, 5)), (4, (4, 4)), ((1, 2), (1, 2)), ("2..2", (2, 2))]
)
def test_a_delay_is_a_number_or_a_range(value, ends):
    assert parse_delay(value) == ends
    assert ImitationOptions(delay=value).delays == Delays(*ends)


@pytest.mark.parametrize(
    "value", ["", "x", "-1", "5..2", "..", "0..", "..5", "0...5", "1.5", "0..1001", 2.0, True, None, -1, (3, 1), (1,), (0, 1.0)]
)
def test_another_delay_is_refused_with_what_was_expected(value):
    with pytest.raises(ValueError) as refused:
        ImitationOptions(delay=value)
    assert str(refused.value) == (
        f"delay: expected 0 to 1000 steps, as a number like 3 or a range like 0..5, received {value}"
    )


def five_beats(**fields):
    """Returns an episode whose expert acts as 10, 11, 12, 13, 14 while 0, 1, 2, 3, 4 is executed."""
    observations = [np.float32([step]) for step in range(6)]
    return Episode(7, observations, [0, 1, 2, 3, 4], [10, 11, 12, 13, 14], [], [1.0] * 5, **fields)


def test_what_is_imitated_is_the_action_of_the_beat_in_which_the_decision_is_executed():
    episode = five_beats(terminated=True)
    moved = label_after(episode, 2)
    assert moved.labels[:3] == [12, 13, 14]
    assert moved.weights == [1, 1, 1, 0, 0]  # the last two decisions are never executed
    assert moved.actions == [0, 1, 2, 3, 4]  # what the policy remembers
    assert moved.terminated
    assert moved.steps == 5
    assert label_after(episode, 0).labels == episode.labels
    assert label_after(episode, 4).labels[0] == 14
    assert label_after(episode, 5) is None
    episode.weights = [1.0, 2.0, 3.0, 4.0, 5.0]
    assert label_after(episode, 2).weights == [3, 4, 5, 0, 0]
    episode.labels = []
    assert label_after(episode, 2).labels[:3] == [2, 3, 4]  # of data without labels, what was executed


def test_each_episode_draws_a_delay_and_too_short_ones_are_left_out():
    delays = Delays(1, 3)
    drawn = [delays.drawn(0, seed) for seed in range(300)]
    assert drawn == [delays.drawn(0, seed) for seed in range(300)]
    assert all(80 < drawn.count(delay) < 120 for delay in (1, 2, 3))
    assert [delays.in_turn(seed) for seed in range(4)] == [1, 2, 3, 1]
    assert label_all_after([five_beats()], Delays(), 0)[0].labels == [10, 11, 12, 13, 14]
    with pytest.raises(ValueError, match=r"^delay: expected fewer steps than the longest episode has, 5, received 5"):
        label_all_after([five_beats()], Delays(5, 5), 0)


class CountingPolicy:
    """Decides 0.01, 0.02, ... and keeps what it is told."""

    def __init__(self):
        self.told = []

    def session(self):
        return self

    def act(self, observation, reward, *, executed_action=None):
        self.told.append(executed_action)
        return SimpleNamespace(action=np.float32([len(self.told) / 100]), stats=SimpleNamespace(spikes=1))

    def end_episode(self, reward, terminated, truncated, *, executed_action):
        self.told.append(executed_action)


def expert_of(environment):
    """Pushes as hard as the pendulum is fast."""
    return np.clip(environment.unwrapped.state[1:], -2, 2).astype(np.float32)


def play_pendulum(delay, bursts=None):
    policy = CountingPolicy()
    actor = DelayedStudentActor(policy, lambda seed: delay, expert_of, bursts)
    make = EnvironmentFactory("Pendulum-v1", max_episode_steps=8).make
    (episode,) = play(make, actor, iter([3]), 1)
    return policy, episode


def test_a_decision_is_executed_after_the_delay_and_the_policy_remembers_what_was():
    policy, episode = play_pendulum(delay=3)
    decided = [np.float32([step / 100]) for step in range(1, 9)]
    np.testing.assert_array_equal(episode.actions, [np.float32([0])] * 3 + decided[:5])
    assert policy.told[0] is None
    np.testing.assert_array_equal(policy.told[1:], episode.actions)
    # The expert is asked in every state that is reached, and imitated in the one that is executed in.
    speeds = np.array(episode.observations)[:-1, 2:]
    np.testing.assert_allclose(episode.labels, np.clip(speeds, -2, 2), atol=1e-6)
    np.testing.assert_array_equal(label_after(episode, 3).labels[:5], episode.labels[3:])


def test_bursts_replace_what_arrives_and_the_policy_is_told():
    policy, episode = play_pendulum(2, Bursts(seed=1, disturbed=1.0, rate=1.0, longest=8))
    calm = play_pendulum(2)[1]
    assert not np.array_equal(episode.actions, calm.actions)
    np.testing.assert_array_equal(policy.told[1:], episode.actions)


def test_a_run_imitates_and_evaluates_with_the_delay(tmp_path):
    options = ImitationOptions(
        delay="1..2",
        environments=3,
        steps=300,
        burst_rate=0.0,
        longest_burst=1,
        hidden_size=16,
        layers=1,
        batch=2,
        context=4,
        clip_steps=4,
        action_noise=0.0,
        iterations=3,
        rounds=1,
        round_steps=60,
        round_disturbed=0.0,
        round_iterations=2,
        silence=(),
        selection_episodes=4,
        episodes=4,
        train_flags=("--heads=2",),
    )
    result = imitate("CartPole-v1", "home_made:balance", tmp_path, options=options)
    assert "The policies play with 1 to 2 steps of delay" in result.report.read_text()
    recorded = json.loads((tmp_path / "settings.json").read_text())
    assert recorded["delay"] == "1..2"
    delays = set()
    for name in ("expert-v0", "round1-v0"):
        for episode in read_dataset(tmp_path / "data" / name):
            delay = episode.weights.count(0.0)
            delays.add(delay)
            assert episode.weights == [1.0] * (episode.steps - delay) + [0.0] * delay
            if name == "round1-v0":
                assert episode.actions[:delay] == [0] * delay  # until the first decision arrives
            else:
                assert episode.labels[: episode.steps - delay] == episode.actions[delay:]
    assert delays == {1, 2}
    assert result.baselines == {}  # they would imitate other labels


def test_the_command_refuses_a_range_before_it_records(tmp_path):
    command = [sys.executable, "-m", "spikeserve", "imitate", "CartPole-v1", "--expert=home_made:balance"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    finished = run(*command, f"--out={tmp_path / 'run'}", "--delay=5..0", status=1, env=environment)
    assert finished.stderr == (
        "spikeserve imitate: delay: expected 0 to 1000 steps, as a number like 3 or a range like 0..5, received 5..0\n"
    )
    assert not (tmp_path / "run").exists()
