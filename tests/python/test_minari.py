"""Minari reads the datasets of spiketrain, and spiketrain trains on datasets of Minari."""

import os
import pathlib
import subprocess

import gymnasium
import minari
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

SPIKETRAIN = os.environ["SPIKETRAIN_PROGRAM"]
TINY = "--hidden_size=16 --heads=2 --context=4 --iterations=2 --batch=2 --episodes=1".split()


def spiketrain(*arguments: str) -> str:
    return subprocess.run([SPIKETRAIN, *arguments], check=True, capture_output=True, text=True).stdout


def test_minari_loads_a_recording_and_gymnasium_replays_it(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    spiketrain("dataset", "--steps=800", "--disturbed_fraction=0.2", f"--out={tmp_path}/cartpole-mixed-v0")
    dataset = minari.load_dataset("cartpole-mixed-v0")
    assert dataset.total_steps == sum(len(episode.actions) for episode in dataset.iterate_episodes()) >= 800
    environment = dataset.recover_environment()
    actors = set()
    for episode in dataset.iterate_episodes():
        (metadata,) = dataset.storage.get_episode_metadata([episode.id])
        actors.add(metadata["actor"])
        observation, _ = environment.reset(seed=metadata["seed"])
        np.testing.assert_array_equal(observation, episode.observations[0])
        for t, action in enumerate(episode.actions):
            observation, reward, terminated, truncated, _ = environment.step(action)
            np.testing.assert_allclose(observation, episode.observations[t + 1], atol=1e-6)
            assert reward == episode.rewards[t]
            assert (terminated, truncated) == (episode.terminations[t], episode.truncations[t])
        if metadata["actor"] == "disturbed":
            assert episode.infos["label"].shape == (len(episode.actions) + 1,)
    assert actors == {"expert", "disturbed", "random"}


def record_with_minari(environment_id: str, directory: pathlib.Path) -> None:
    environment = gymnasium.make(environment_id)
    environment.action_space.seed(0)
    (directory / "data").mkdir(parents=True)
    storage = MinariStorage.new(
        directory / "data",
        observation_space=environment.observation_space,
        action_space=environment.action_space,
        env_spec=environment.spec,
    )
    episodes = []
    for seed in range(3):
        observation, _ = environment.reset(seed=seed)
        observations, steps, done = [observation], [], False
        while not done:
            action = environment.action_space.sample()
            observation, reward, terminated, truncated, _ = environment.step(action)
            observations.append(observation)
            steps.append((action, reward, terminated, truncated))
            done = terminated or truncated
        actions, rewards, terminations, truncations = map(list, zip(*steps))
        episodes.append(EpisodeBuffer(seed, seed, None, observations, actions, rewards, terminations, truncations))
    storage.update_episodes(episodes)
    storage.update_metadata({"dataset_id": directory.name, "minari_version": minari.__version__})


def test_an_environment_that_is_not_ours_is_trained_and_not_played(tmp_path):
    directory = tmp_path / "car-random-v0"
    record_with_minari("MountainCarContinuous-v0", directory)
    assert spiketrain("train", f"--data={directory}", f"--out={tmp_path}/run", *TINY) == ""
    assert (tmp_path / "run" / "policy.safetensors").exists()


@pytest.mark.parametrize("environment_id", ["CartPole-v1", "Pendulum-v1"])
def test_spiketrain_trains_on_minari_data(environment_id, tmp_path):
    directory = tmp_path / "random-v0"
    record_with_minari(environment_id, directory)
    printed = spiketrain("train", f"--data={directory}", f"--out={tmp_path}/run", *TINY)
    assert printed.startswith(f"{environment_id}, 1 episodes")
