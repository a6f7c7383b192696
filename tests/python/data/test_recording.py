"""Minari reads the episodes that a server recorded and spiketrain converted."""

import json

import cbor2
import gymnasium
import minari
import numpy as np
import pytest
import spikeserve
from policy_file import read_policy
from serving import SHIPPED_POLICIES, run, running_server
from tritonclient import grpc as triton
from tritonclient.utils import InferenceServerException

SEED = 1_000_000
EPISODES = 2


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Plays and records episodes. Returns the folder of recordings, and the values of each episode."""
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


def play_sequence(client, environment, sequence_id, seed, end=None):
    """Plays an episode as a sequence, whose last request has the parameters `end`. Returns the recording, observations
    and actions."""
    observation, _ = environment.reset(seed=seed)
    observations, actions, recording = [observation], [], None
    reward, start, over = 0.0, True, False
    while True:
        inputs = []
        for name, values in (("observation", observation), ("reward", [reward])):
            array = np.asarray(values, np.float32)
            tensor = triton.InferInput(name, array.shape, "FP32")
            inputs.append(tensor.set_data_from_numpy(array))
        result = client.infer(
            "cartpole",
            inputs,
            sequence_id=sequence_id,
            sequence_start=start,
            sequence_end=over,
            parameters={"record": True} if start else end if over else None,
        )
        if start:
            recording = result.get_response().parameters["recording"].string_param
        if over:
            return recording, observations, actions
        actions.append(int(result.as_numpy("action")[0]))
        observation, reward, terminated, truncated, _ = environment.step(actions[-1])
        observations.append(observation)
        start, over = False, terminated or truncated


def test_sequences_of_tritons_client_are_recorded(tmp_path, monkeypatch):
    folder = tmp_path / "recordings"
    with (
        running_server(flags=[f"--record_dir={folder}"]) as server,
        gymnasium.make("CartPole-v1") as environment,
    ):
        client = triton.InferenceServerClient(server.grpc)
        recording, observations, actions = play_sequence(client, environment, 7, SEED)
        client.close()
    with running_server() as server:
        replay = json.loads(server.spikectl("replay", f"--recording={folder / recording}", "--json").stdout)
    assert replay["identical"]
    assert replay["decisions"] == len(actions)

    out = tmp_path / "sequence-v0"
    run("spiketrain", "dataset", f"--recordings={folder}", f"--out={out}")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    (read,) = minari.load_dataset("sequence-v0").iterate_episodes()
    # The recording has the observation of the request with sequence_end, but not its answer.
    np.testing.assert_array_equal(read.observations, np.stack(observations))
    np.testing.assert_array_equal(read.actions, actions)
    np.testing.assert_array_equal(read.rewards, np.ones(len(actions)))
    assert bool(read.terminations[-1]) and not bool(read.truncations[-1])


@pytest.mark.parametrize("end", [{"terminated": True}, {"truncated": True}, None], ids=["terminated", "truncated", "plain"])
def test_a_sequence_ends_as_its_client_says(end, tmp_path):
    with (
        running_server(flags=[f"--record_dir={tmp_path}"]) as server,
        gymnasium.make("CartPole-v1", max_episode_steps=5) as environment,
    ):
        client = triton.InferenceServerClient(server.grpc)
        recording, observations, actions = play_sequence(client, environment, 7, SEED, end)
        with pytest.raises(InferenceServerException, match="sequence_end: expected true beside terminated or truncated"):
            tensor = triton.InferInput("observation", [4], "FP32").set_data_from_numpy(observations[0])
            parameters = {"terminated": True}
            client.infer("cartpole", [tensor], sequence_id=8, sequence_start=True, parameters=parameters)
        client.close()
    (episode,) = cbor2.loads((tmp_path / recording / "000000.cbor").read_bytes())["episodes"]
    terminated = end != {"truncated": True}
    assert (episode["terminated"], episode["truncated"]) == (terminated, not terminated)
    assert len(episode["actions"]) == len(actions)


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
    run("spiketrain", "dataset", f"--recordings={folder}", f"--out={tmp_path}/cartpole-served-v0")
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


@pytest.mark.parametrize("recorded", [True, False])
def test_corrections_are_weighed_where_there_are_some(played, tmp_path, recorded):
    folder = played[0]
    flags = [f"--recordings={folder}"] if recorded else ["--steps=10"]
    refused = run("spiketrain", "dataset", *flags, f"--out={tmp_path}/served.cbor", "--correction_weight=1", status=1)
    expected = "recordings in which an operator acted" if recorded else "--recordings beside it"
    assert refused.stderr == f"spiketrain: --correction_weight: expected {expected}, received none\n"
    assert not (tmp_path / "served.cbor").exists()


def test_spiketrain_trains_on_it(played, tmp_path):
    folder, _ = played
    run("spiketrain", "dataset", f"--recordings={folder}", f"--out={tmp_path}/served.cbor")
    tiny = "--hidden_size=8 --heads=2 --layers=1 --ticks=4 --context=4 --iterations=2 --batch=2 --episodes=1 --no_baselines".split()
    report = run("spiketrain", "train", f"--data={tmp_path}/served.cbor", f"--out={tmp_path}/policy", *tiny, "--json")
    assert json.loads(report.stdout)
    trained, served = (
        {kind: [element["name"] for element in features[kind]] for kind in ("observation", "action")}
        for path in (tmp_path / "policy", SHIPPED_POLICIES / "cartpole/2")
        for features in [json.loads(read_policy(path / "policy.safetensors")[1]["features"])]
    )
    assert trained == served  # the server has recorded the names


def test_the_whole_recording_is_replayed(played):
    folder, episodes = played
    (recording,) = folder.iterdir()
    with running_server() as server:
        replay = json.loads(server.spikectl("replay", f"--recording={recording}", "--json").stdout)
    assert replay["identical"]
    assert replay["episodes"] == EPISODES
    assert replay["decisions"] == sum(len(actions) for _, actions, *_ in episodes)
