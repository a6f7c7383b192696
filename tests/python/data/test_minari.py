"""Minari reads the datasets of spiketrain, and spiketrain trains on datasets of Minari."""

import json
import os
import pathlib
import subprocess

import gymnasium
import minari
import numpy as np
import pytest
import safetensors
from gymnasium import spaces
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from serving import run

SPIKETRAIN = os.environ["SPIKETRAIN_PROGRAM"]
TINY = "--hidden_size=16 --heads=2 --context=4 --iterations=2 --batch=2 --episodes=1".split()
# What takes nine tenths of such a training.
TINY += ["--no_baselines", "--observation_changes=false"]


def spiketrain(*arguments: str) -> str:
    return run("spiketrain", *arguments).stdout


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
    printed = spiketrain("train", f"--data={directory}", f"--out={tmp_path}/run", *TINY)
    assert "closed-loop play: skipped, because spiketrain does not have MountainCarContinuous-v0" in printed
    assert (tmp_path / "run" / "policy.safetensors").exists()


@pytest.mark.parametrize("environment_id", ["CartPole-v1", "Pendulum-v1"])
def test_spiketrain_trains_on_minari_data(environment_id, tmp_path):
    directory = tmp_path / "random-v0"
    record_with_minari(environment_id, directory)
    printed = spiketrain("train", f"--data={directory}", f"--out={tmp_path}/run", *TINY)
    assert f"{environment_id}, 1 episodes" in printed


def record_spaces(directory: pathlib.Path, observation_space: spaces.Space, action_space: spaces.Space) -> None:
    """Records random episodes of an environment that Gymnasium does not know."""
    (directory / "data").mkdir(parents=True)
    storage = MinariStorage.new(
        directory / "data", observation_space=observation_space, action_space=action_space, jpeg_encoding=False
    )
    observation_space.seed(0)
    action_space.seed(0)
    episodes = []
    for seed in range(3):
        observations = [observation_space.sample() for _ in range(9)]
        if isinstance(observation_space, spaces.Dict):
            observations = {key: np.stack([o[key] for o in observations]) for key in observation_space}
        actions = [action_space.sample() for _ in range(8)]
        ends = [False] * 7 + [True]
        episodes.append(EpisodeBuffer(seed, seed, None, observations, actions, [1.0] * 8, ends, [False] * 8))
    storage.update_episodes(episodes)
    storage.update_metadata({"dataset_id": directory.name, "minari_version": minari.__version__})


@pytest.mark.parametrize(
    ("observation_space", "size", "action_space", "expected"),
    [
        (spaces.Box(-1, 1, (2, 3), np.float64), 6, spaces.Discrete(3, start=5), {"type": "Discrete", "n": 3}),
        (spaces.Box(0, 9, (4,), np.int64), 4, spaces.MultiDiscrete([2, 3]), {"type": "Discrete", "n": 6}),
        (
            spaces.Box(-1, 1, (1,), np.float32),
            1,
            spaces.Box(np.array([[-1.0, 0.0], [2.0, 3.0]]), np.array([[1.0, 0.5], [4.0, 9.0]]), dtype=np.float64),
            {"type": "Box", "low": [-1, 0, 2, 3], "high": [1, 0.5, 4, 9]},
        ),
    ],
    ids=["start", "multidiscrete", "box"],
)
def test_spaces_of_others_are_mapped(observation_space, size, action_space, expected, tmp_path):
    directory = tmp_path / "other-v0"
    record_spaces(directory, observation_space, action_space)
    spiketrain("train", f"--data={directory}", f"--out={tmp_path}/run", *TINY)
    with safetensors.safe_open(tmp_path / "run/policy.safetensors", "np") as file:
        assert json.loads(file.metadata()["action_space"]) == expected
        assert file.get_tensor("observation.mean").shape == (size,)


@pytest.mark.parametrize(
    ("observation_space", "action_space", "reason"),
    [
        (spaces.Dict({"a": spaces.Box(0, 1, (2,))}), spaces.Discrete(2), "observation_space: expected Box, received Dict"),
        (spaces.Box(0, 1, (2,)), spaces.MultiBinary(3), "action_space: expected Discrete, MultiDiscrete or Box"),
        (spaces.Box(0, 1, (2,)), spaces.MultiDiscrete([99, 99]), "action_space: expected at most 4096 combinations"),
    ],
    ids=["dict", "multibinary", "multidiscrete"],
)
def test_spaces_that_cannot_be_mapped_are_refused_by_name(observation_space, action_space, reason, tmp_path):
    directory = tmp_path / "other-v0"
    record_spaces(directory, observation_space, action_space)
    refused = run("spiketrain", "train", f"--data={directory}", f"--out={tmp_path}/run", *TINY, status=1)
    assert reason in refused.stderr


LARGE_EPISODES, LARGE_STEPS, LARGE_OBSERVATION = 240, 100, 1024  # 98 MB of observations
MIB = 1 << 20


def write_large_dataset(directory: pathlib.Path, episodes: int) -> None:
    (directory / "data").mkdir(parents=True)
    storage = MinariStorage.new(
        directory / "data",
        observation_space=spaces.Box(-1, 1, (LARGE_OBSERVATION,), np.float32),
        action_space=spaces.Discrete(2),
        env_spec=gymnasium.envs.registration.EnvSpec("Large-v0"),
    )
    random = np.random.default_rng(len(directory.name))
    for seed in range(episodes):
        observations = random.uniform(-1, 1, (LARGE_STEPS + 1, LARGE_OBSERVATION)).astype(np.float32)
        actions = random.integers(0, 2, LARGE_STEPS)
        ends = [False] * (LARGE_STEPS - 1) + [True]
        rewards = [1.0] * LARGE_STEPS
        storage.update_episodes(
            [EpisodeBuffer(seed, seed, None, observations, actions, rewards, ends, [False] * LARGE_STEPS)]
        )
    storage.update_metadata({"dataset_id": directory.name, "minari_version": minari.__version__})


def peak_memory(data: list[pathlib.Path], out: pathlib.Path, data_memory: int) -> int:
    """Trains and returns the most memory, in bytes, that spiketrain or a child process of it had."""
    flags = [f"--data={','.join(map(str, data))}", f"--out={out}", f"--data_memory={data_memory}"]
    # 30,000 steps: a pass over all chunks, and the beginning of another.
    size = ["--hidden_size=16", "--heads=2", "--context=20", "--batch=50", "--iterations=30", "--mode=baseline", *TINY[-2:]]
    with open(out.with_suffix(".log"), "wb") as log:
        process = subprocess.Popen([SPIKETRAIN, "train", *flags, *size], stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, out.with_suffix(".log").read_text()
    return usage.ru_maxrss * 1024


def test_data_larger_than_the_memory_are_read_in_chunks(tmp_path):
    """Resident memory, measured: two files of 98 MB together, with 16 MiB and with enough memory for all."""
    small, first, second = (tmp_path / name for name in ("small-v0", "first-v0", "second-v0"))
    write_large_dataset(small, 4)
    write_large_dataset(first, LARGE_EPISODES // 2)
    write_large_dataset(second, LARGE_EPISODES // 2)
    data_bytes = LARGE_EPISODES * LARGE_STEPS * LARGE_OBSERVATION * 4
    alone = peak_memory([small], tmp_path / "alone", 4096)
    whole = peak_memory([first, second], tmp_path / "whole", 4096)
    chunked = peak_memory([first, second], tmp_path / "chunked", 16)
    print(f"peak memory: {alone / MIB:.0f} MiB alone, {whole / MIB:.0f} whole, {chunked / MIB:.0f} in chunks")
    assert whole > alone + 0.8 * data_bytes
    # Beside its 16 MiB it holds what is being transferred from the process that reads.
    assert chunked < alone + (16 + 64) * MIB
