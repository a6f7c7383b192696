"""The perceptron of `spiketrain compare` plays Pendulum as well as one that NumPy fitted to the same data."""

import json
import os
import pathlib
import subprocess

import numpy as np
import pytest
import queue_baselines
from spikeserve.imitation.baselines import BaselineActor, Comparison
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play

ROOT = pathlib.Path(__file__).parents[2]
STARTS = range(2_000_000, 2_000_100)
WIDTH, EPOCHS = 64, 40
HIGHEST = 2.0  # torque


def run(folder, *arguments):
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([os.environ["SPIKETRAIN"], *arguments], cwd=folder, check=True, env=environment, stdout=subprocess.PIPE)


def returns_of(actor):
    factory = EnvironmentFactory("Pendulum-v1")
    episodes = sorted(play(factory.make, actor, iter(STARTS), 16), key=lambda episode: episode.seed)
    return np.array([episode.episode_return for episode in episodes])


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Records the expert's answers to states that bursts of random actions reach. Returns the folder."""
    folder = tmp_path_factory.mktemp("rivals")
    bursts = ("--expert_fraction=0", "--disturbed_fraction=1", "--wide_start_fraction=0.25")
    run(folder, "dataset", "--env=Pendulum-v1", "--expert=cautious", "--steps=30000", *bursts, "--out=pendulum-v0")
    return folder


def test_the_perceptron_is_within_two_standard_errors_of_an_independent_fit(data):
    policy = ROOT / "deploy/policies/pendulum/1/policy.safetensors"
    run(data, "compare", f"--policy={policy}", "--data=pendulum-v0", "--episodes=1", "--out=compared.json")
    (ours,) = [b for b in Comparison.read(data / "compared.json").baselines if b.name == "mlp on 1 frame"]
    assert json.loads((data / "compared.json").read_text())["baselines"][3]["width"] in (32, WIDTH)

    episodes = queue_baselines.read([data / "pendulum-v0"])
    inputs, labels = queue_baselines.Queues(episodes, 1), np.concatenate([labels for _, labels in episodes])
    inputs.standardise()
    model = queue_baselines.Perceptron([inputs.size, WIDTH, WIDTH, 1], seed=0)
    model.train(inputs, labels / HIGHEST, EPOCHS)
    queue_baselines.absorb(model, inputs.mean, inputs.deviation)
    choice = lambda outputs: queue_baselines.Choice(np.clip(HIGHEST * outputs, -HIGHEST, HIGHEST).astype(np.float32))  # noqa: E731

    differences = returns_of(BaselineActor(ours)) - returns_of(queue_baselines.QueueActor(model, 1, choice))
    assert differences.mean() > -2 * differences.std(ddof=1) / len(differences) ** 0.5
