"""What `imitate` chooses where a setting is not given: by the expert's pace and by the recorded data."""

import dataclasses
import re

import hidden_state
import numpy as np
import pytest
from documentation import Shell, files_of
from spikeserve.imitation import memory
from spikeserve.imitation.actors import Bursts, ExpertActor, StudentActor
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play
from spikeserve.imitation.experts import load_expert
from spikeserve.imitation.figures import Evaluator
from spikeserve.imitation.memory import ask, plan_training
from spikeserve.imitation.options import CHOSEN, ImitationOptions
from spikeserve.imitation.pace import plan_recording

OPTIONS = ImitationOptions()


def push_left(observation):
    """An expert for CartPole that falls after a few random actions."""
    return int(0.1 * observation[0] + 0.3 * observation[1] + 3 * observation[2] + observation[3] > 0)


def recorded(folder, name, expert, episodes=120, bursts=None):
    """Records an expert. Returns the folder and the action space."""
    factory = EnvironmentFactory(name)
    bursts = bursts or Bursts(0, 0.8, 0.3, 8, 0.5)
    written = list(play(factory.make, ExpertActor(load_expert(expert), bursts), iter(range(episodes)), 16))
    environment = factory.make()
    write_dataset(folder / "expert-v0", written, environment, factory.name)
    return folder / "expert-v0", environment.actions.space


@pytest.mark.parametrize(
    ("name", "expert", "context", "noise"),
    [
        ("hidden_state:Reacher2D-v0", hidden_state.reach, 3, 0.5),
        ("hidden_state:Spring-v0", hidden_state.hold, 3, 0.5),
        ("hidden_state:AnglePendulum-v0", hidden_state.swing_up, 3, 0.5),
        # The heat of the last step is in the change of the air, and only the last action tells it.
        ("hidden_state:Thermostat-v0", hidden_state.heat, 2, 0.0),
        ("CartPole-v1", push_left, 2, 0.5),
    ],
)
def test_the_data_decide_what_is_remembered(tmp_path, name, expert, context, noise):
    plan = plan_training(OPTIONS, *recorded(tmp_path, name, expert))
    assert (plan.context, plan.clip_steps, plan.action_noise) == (context, context, noise)
    assert plan.learning_rate == 0.003
    assert 800 <= plan.iterations <= 2000
    assert [reason.split()[0] for reason in plan.reasons] == [
        "context", "action_noise", "clip_steps", "learning_rate", "iterations",
    ]  # fmt: skip


def test_where_one_push_ends_an_episode_the_disturbance_is_weak():
    def plan(name, expert):
        return plan_recording(OPTIONS, load_expert(expert), Evaluator(EnvironmentFactory(name), 16))

    robust, fragile = plan("hidden_state:Reacher2D-v0", hidden_state.reach), plan("CartPole-v1", push_left)
    assert (robust.burst_rate, robust.longest_burst) == (0.3, 8)
    assert (robust.steps, robust.round_steps) == (30_000, 10_000)
    assert (fragile.burst_rate, fragile.longest_burst) < (robust.burst_rate, robust.longest_burst)
    assert fragile.steps == 60_000
    assert "the expert still comes 9" in robust.reasons[1]


def test_given_settings_stay(tmp_path):
    """And the expert and the data are not asked about them."""

    def unasked(environment, observation):
        raise AssertionError

    given = {name: kind(1) for name, kind in CHOSEN.items()} | {"clip_steps": 0}
    options = dataclasses.replace(OPTIONS, **given)
    recording = plan_recording(options, load_expert(unasked), Evaluator(EnvironmentFactory("CartPole-v1"), 2))
    training = plan_training(options, tmp_path / "no-data", None)
    chosen = dataclasses.asdict(recording) | dataclasses.asdict(training)
    assert chosen.pop("reasons") == [] == recording.reasons
    assert chosen == given


def test_a_longer_lookback_lengthens_the_context(tmp_path):
    options = dataclasses.replace(OPTIONS, mode="pos", lookback=7)
    data = recorded(tmp_path, "CartPole-v1", push_left, 20)
    assert plan_training(options, *data).context == 8
    assert plan_training(dataclasses.replace(options, lookback=None, mirror=7), *data).context == 15


def test_one_disturbed_episode_proves_nothing(tmp_path, monkeypatch):
    """Though longer memories and the last action halve its error."""

    def answer(episodes):
        errors = {frames: (np.full(episodes, 1 / frames), np.full(episodes, 0.5 / frames)) for frames in (1, 2, 4)}
        return lambda *_: memory.Answer(errors, disturbed=True)

    data = recorded(tmp_path, "CartPole-v1", push_left, 2)
    for episodes, context, noise in ((1, 2, 0.5), (2, 5, 0.0)):
        monkeypatch.setattr(memory, "ask", answer(episodes))
        plan = plan_training(OPTIONS, *data)
        assert (plan.context, plan.action_noise) == (context, noise)


def test_few_episodes_and_large_observations_are_not_asked(tmp_path):
    options = dataclasses.replace(OPTIONS, iterations=1)
    plan = plan_training(options, *recorded(tmp_path, "hidden_state:Spring-v0", hidden_state.hold, 9))
    assert (plan.context, plan.action_noise) == (5, 0.5)
    factory = EnvironmentFactory("hidden_state:Spring-v0")
    episodes = list(play(factory.make, ExpertActor(load_expert(hidden_state.hold)), iter(range(40)), 4))
    assert not ask(episodes, factory.make().actions.space).disturbed, "without random actions all steps count"
    for episode in episodes:
        episode.observations = [np.zeros(129, np.float32)] * len(episode.observations)
    assert ask(episodes, factory.make().actions.space) is None


class Silent:
    """Stands for an engine whose policy does nothing."""

    class Batch:
        def __init__(self, rows):
            self.actions, self.spikes = np.zeros((rows, 1), np.float32), np.zeros(rows)

    def session(self):
        return self

    def act_batch(self, sessions, observations, rewards):
        return Silent.Batch(len(sessions))

    def end_episode(self, *_):
        pass


def test_bursts_push_the_student_and_can_hold_an_action():
    make = EnvironmentFactory("hidden_state:Spring-v0").make

    def executed(held):
        actor = StudentActor(Silent(), load_expert(hidden_state.hold), Bursts(0, 1.0, 0.3, 8, held))
        (episode,) = play(make, actor, iter([3]), 1)
        assert len(episode.labels) == episode.steps
        actions = np.array(episode.actions).ravel()
        pushed = actions[actions != 0]
        assert 10 < len(pushed) < len(actions)
        return np.mean(np.diff(pushed) == 0)

    assert executed(held=0.0) == 0
    assert executed(held=1.0) > 0.4


SMALL = (
    "--steps=6000 --iterations=150 --rounds=1 --round-steps=1500 --round-iterations=60 --hidden-size=32 --layers=1 "
    "--silence= --selection-episodes=16 --episodes=16 --train-flags='--slope=4 --heads=2'"
)


def walk(folder, flags=""):
    """Returns what the two Python commands of the page print, with flags for the training."""
    for name, text in files_of("imitation.md").items():
        (folder / name).write_text(text)
    train = "imitate reacher:Reacher2D-v0 --expert reacher:reach"
    with Shell(folder) as shell:
        trained, played = shell.run("imitation.md", [(train, f"{train} {flags} 2>&1")])
    return trained, float(re.fullmatch(r"mean return of 20 starts: (-\d+\.\d)\n", played)[1])


def test_the_reacher_is_trained_served_and_played_by_another_client(tmp_path):
    trained, mean_return = walk(tmp_path, SMALL)
    context = re.search(r"^chosen: context = (\d+): observations with which the expert's action", trained, re.MULTILINE)[1]
    assert "chosen: burst_rate = 0.3, longest_burst = 8: " in trained
    assert "on the first 16 of these starts, with the error on held-out episodes:\n" in trained
    for name in ("the policy", "line on 2 frames", "mlp on 4 frames"):
        assert re.search(rf"^{name}: return -\S+ ± \S+, error \d\.\d{{4}}$", trained, re.MULTILINE)
    assert mean_return > -150  # without forces: -413
    report = (tmp_path / "reacher2d/report.md").read_text()
    assert f"- context = {context}: observations with which" in report
    assert f"| `context` | `{context}` |" in report
