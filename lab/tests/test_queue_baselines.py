"""A line on a queue of past observations plays RepeatPrevious, if the queue is long enough."""

import re
import sys

import gru
import memory_experts
import numpy as np
import pytest
import queue_baselines
from spikeserve.imitation.actors import ExpertActor
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play
from spikeserve.imitation.experts import load_expert

ENVIRONMENT = "popgym:popgym-RepeatPreviousEasy-v0"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Records the expert. Returns the folder."""
    factory = EnvironmentFactory(ENVIRONMENT)
    expert = ExpertActor(load_expert(memory_experts.repeat_previous))
    folder = tmp_path_factory.mktemp("data") / "expert-v0"
    environment = factory.make()
    write_dataset(folder, list(play(factory.make, expert, iter(range(100)), 16)), environment, factory.name)
    environment.close()
    return folder


@pytest.mark.parametrize(("length", "hidden", "least", "most"), [(4, 0, 0.99, 1), (3, 0, -1, 0), (4, 16, 0.9, 1)])
def test_the_queue_has_to_hold_what_is_asked_for(recorded, monkeypatch, capsys, length, hidden, least, most):
    flags = [f"--data={recorded}", f"--length={length}", f"--hidden={hidden}", "--episodes=10", "--epochs=40"]
    monkeypatch.setattr(sys, "argv", ["queue_baselines.py", ENVIRONMENT, *flags])
    queue_baselines.main()
    printed = capsys.readouterr().out
    found = re.fullmatch(rf"hidden {hidden}, \S+ of the labels: return (\S+) ± \S+, (\d+) multiplications\n", printed)
    assert least <= float(found[1]) <= most
    assert int(found[2]) == (16 * length if hidden == 0 else 64 * length + 256 + 64)


def test_a_recurrent_unit_remembers_what_it_observed(recorded, monkeypatch, capsys):
    flags = [f"--data={recorded}", "--length=1", "--hidden=", "--gru=32", "--gru_epochs=80", "--episodes=10"]
    monkeypatch.setattr(sys, "argv", ["queue_baselines.py", ENVIRONMENT, *flags])
    queue_baselines.main()
    found = re.fullmatch(r"unit of 32: return (\S+) ± \S+, (\d+) multiplications\n", capsys.readouterr().out)
    assert float(found[1]) > 0  # random actions: -0.5
    assert int(found[2]) == 3 * 32 * (4 + 32 + 1) + 32 * 4


def test_the_gradients_of_a_recurrent_unit_are_those_of_its_loss():
    random = np.random.default_rng(0)
    unit = gru.Gru(3, 5, 4, seed=0)
    parameters = unit.parameters
    inputs, labels = random.normal(size=(6, 2, 3)), random.integers(0, 4, (6, 2))
    weights = np.ones((6, 2))
    weights[4:, 1] = 0  # a shorter episode
    for name, values in list(parameters.items()):
        parameters[name] = values.astype(np.float64)
    gradients = unit.gradients(inputs, labels, weights)[1]
    for name, values in parameters.items():
        place = tuple(random.integers(0, size) for size in values.shape)
        losses = []
        for step in (1e-5, -2e-5):
            values[place] += step
            losses.append(unit.gradients(inputs, labels, weights)[0])
        assert gradients[name][place] == pytest.approx((losses[0] - losses[1]) / 2e-5, rel=1e-4, abs=1e-9), name
