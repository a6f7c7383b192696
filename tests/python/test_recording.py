"""Episodes that a server recorded, converted by spiketrain, as Minari itself reads them."""

import json
import os
import subprocess

import gymnasium
import minari
import numpy as np
import pytest
import spikeserve
from serving import running_server

SEED = 1_000_000
EPISODES = 2


def run(program, *arguments):
    return subprocess.run(
        [os.environ[program], *arguments], check=True, capture_output=True, text=True
    ).stdout


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A directory of recordings, and what was observed, done and got in each episode."""
    folder = tmp_path_factory.mktemp("recordings")
    with (
        running_server(flags=[f"--record_dir={folder}"]) as server,
        spikeserve.Client(server.grpc) as client,
        gymnasium.make("CartPole-v1") as environment,
    ):
        options = spikeserve.SessionOptions(record=True, labels={"robot": "7"})
        with client.open_session("cartpole", options) as session:
            assert session.opening.recording.startswith("cartpole-")
            episodes = [play(environment, session, SEED + i) for i in range(EPISODES)]
    return folder, episodes


def play(environment, session, seed):
    observation, _ = environment.reset(seed=seed)
    observations, actions, returns_to_go = [observation], [], []
    reward, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        decision = session.act(observation, reward)
        observation, reward, terminated, truncated, _ = environment.step(decision.action)
        observations.append(observation)
        actions.append(decision.action)
        returns_to_go.append(decision.return_to_go)
    session.end_episode(reward, terminated, truncated, observation=observation)
    return observations, actions, returns_to_go, terminated, truncated


def test_minari_reads_what_was_played(played, tmp_path, monkeypatch):
    folder, episodes = played
    run(
        "SPIKETRAIN_PROGRAM",
        "dataset",
        f"--recordings={folder}",
        f"--out={tmp_path}/cartpole-served-v0",
    )
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("cartpole-served-v0")
    assert dataset.total_episodes == EPISODES
    assert dataset.action_space == gymnasium.spaces.Discrete(2)
    for read, expected in zip(dataset.iterate_episodes(), episodes, strict=True):
        observations, actions, returns_to_go, terminated, truncated = expected
        np.testing.assert_array_equal(read.observations, np.stack(observations))
        np.testing.assert_array_equal(read.actions, actions)
        np.testing.assert_array_equal(read.rewards, np.ones(len(actions)))
        assert bool(read.terminations[-1]) == terminated
        assert bool(read.truncations[-1]) == truncated
        np.testing.assert_array_equal(read.infos["return_to_go"][:-1], returns_to_go)


def test_spiketrain_trains_on_it(played, tmp_path):
    folder, _ = played
    run("SPIKETRAIN_PROGRAM", "dataset", f"--recordings={folder}", f"--out={tmp_path}/served.cbor")
    report = run(
        "SPIKETRAIN_PROGRAM",
        "train",
        f"--data={tmp_path}/served.cbor",
        f"--out={tmp_path}/policy",
        "--hidden_size=8",
        "--heads=2",
        "--layers=1",
        "--ticks=4",
        "--context=4",
        "--iterations=2",
        "--batch=2",
        "--episodes=1",
        "--json",
    )
    assert json.loads(report)
    assert (tmp_path / "policy" / "policy.safetensors").exists()


def test_the_whole_recording_is_replayed(played):
    folder, episodes = played
    (recording,) = folder.iterdir()
    with running_server() as server:
        replay = json.loads(
            run(
                "SPIKECTL_PROGRAM",
                "replay",
                f"--recording={recording}",
                f"--server={server.grpc}",
                "--json",
            )
        )
    assert replay["identical"]
    assert replay["episodes"] == EPISODES
    assert replay["decisions"] == sum(len(actions) for _, actions, *_ in episodes)
