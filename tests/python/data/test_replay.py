"""Episodes that a real server records, and that `spikectl replay` plays again on another one."""

import json
import math

import cbor2
import grpc
import pytest
from security import OBSERVATION, fails_with, until
from serving import RELEASED_POLICIES, SHIPPED_POLICIES, add_version, metric, running_server, series


@pytest.fixture
def policies(tmp_path):
    """Makes a folder with policies of both kinds of spaces, in integers and in float32."""
    folder = tmp_path / "policies"
    add_version(folder, "cartpole", 1, RELEASED_POLICIES / "cartpole-sparse/1")
    add_version(folder, "cartpole", 2, SHIPPED_POLICIES / "cartpole-small/1")
    add_version(folder, "pendulum", 1, SHIPPED_POLICIES / "pendulum/1")
    return folder


@pytest.fixture
def recordings(tmp_path):
    return tmp_path / "recordings"


def recording_server(policies, recordings):
    return running_server(policies, [f"--record_dir={recordings}"])


def record(policies, recordings, *flags):
    """Records episodes that `spikectl run` plays. Returns the folder of the recording."""
    with recording_server(policies, recordings) as server:
        assert "recorded as" in server.spikectl("run", "--record", "--seed=3", *flags).stderr
    [recording] = recordings.iterdir()
    return recording


def episodes_of(folder):
    """Returns the recorded episodes below a folder."""
    files = sorted(folder.rglob("*.cbor"))
    return [episode for file in files for episode in cbor2.loads(file.read_bytes())["episodes"]]


@pytest.mark.parametrize(("policy", "version"), [("cartpole", 1), ("cartpole", 2), ("pendulum", 1)])
def test_a_replay_is_the_same_bit_for_bit(policies, recordings, policy, version):
    environment = {"cartpole": "CartPole-v1", "pendulum": "Pendulum-v1"}[policy]
    recording = record(policies, recordings, f"--env={environment}", f"--version={version}", "--episodes=2")
    played = episodes_of(recording)
    assert len(played) == 2
    assert all(episode["terminated"] or episode["truncated"] for episode in played)
    with running_server(policies) as server:
        replay = json.loads(server.spikectl("replay", f"--recording={recording}", "--json").stdout)
    assert (replay["identical"], replay["episodes"]) == (True, 2)
    assert replay["decisions"] == sum(len(episode["actions"]) for episode in played)


def test_a_replay_finds_the_first_difference(policies, recordings):
    recording = record(policies, recordings, "--env=CartPole-v1", "--episodes=2")
    second = recording / "000001.cbor"
    dataset = cbor2.loads(second.read_bytes())
    changed = dataset["episodes"][0]["served"]["probabilities"]
    changed[3] += 1e-6  # of the second action at step 1
    second.write_bytes(cbor2.dumps(dataset))
    steps = len(episodes_of(recording)[0]["actions"])
    with running_server(policies) as server:
        replay = server.spikectl("replay", f"--recording={recording}", "--json", status=1)
        assert "differs at episode 1, step 1" in replay.stderr
        shown = json.loads(replay.stdout)
        assert (shown["identical"], shown["difference"]["field"]) == (False, "action_probabilities")
        assert shown["decisions"] == steps + 1
        alone = server.spikectl("replay", f"--recording={second}", status=1)
        assert "differs at episode 1, step 1" in alone.stderr
        for flags, message in (
            ([f"--recording={recording}", "--policy=pendulum"], "observation: expected 3 numbers, received 4"),
            ([f"--recording={recording}", "--version=9"], "received 9"),
            ([], "--recording: expected a directory or a file"),
        ):
            assert message in server.spikectl("replay", *flags, status=1).stderr


def opened(server, **fields):
    """Opens a session that is recorded. Returns its id."""
    session = server.agent.OpenSession(policy="cartpole", record=True, **fields)
    assert session.recording.startswith("cartpole")
    return session.session_id


def act(server, session, step=0):
    server.agent.Act(session_id=session, step=step, observation=OBSERVATION)


def test_what_is_cut_off_is_kept(policies, recordings):
    with recording_server(policies, recordings) as server:
        closed, _ = sessions = [opened(server) for _ in range(2)]
        for session in sessions:
            for step in range(5):
                act(server, session, step)
        server.agent.CloseSession(session_id=closed)
        act(server, opened(server))  # nobody rewarded its only step
    assert [(len(episode["actions"]), episode["truncated"]) for episode in episodes_of(recordings)] == [(4, True)] * 2


def test_only_sessions_that_ask_are_recorded_and_counted(policies, recordings):
    with recording_server(policies, recordings) as server:
        server.spikectl("run", "--env=CartPole-v1", "--quiet")
        session = opened(server)
        act(server, session)
        with fails_with(grpc.StatusCode.INVALID_ARGUMENT, "observation: expected 4 numbers, received 1"):
            server.agent.EndEpisode(session_id=session, reward=1.0, observation=[1.0])
        server.agent.EndEpisode(session_id=session, reward=1.0)
        until(lambda: sum(series(server, "spikeserve_recorded_episodes_total", outcome="written")) == 1)
        assert metric(server, "spikeserve_recorded_episodes_total") == 1
    [episode] = episodes_of(recordings)
    assert (len(episode["actions"]), episode["terminated"], episode["truncated"]) == (1, False, True)
    assert [math.isnan(number) for number in episode["observations"]] == [False] * 4 + [True] * 4  # the last one is unknown


def test_without_a_directory_nothing_is_recorded(policies):
    with running_server(policies) as server, fails_with(grpc.StatusCode.FAILED_PRECONDITION, "--record_dir"):
        opened(server)
