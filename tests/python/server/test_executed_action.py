"""Sessions whose agents execute other actions than the answered ones, with real programs."""

import asyncio
import json
import os
import shutil

import cbor2
import grpc
import gymnasium
import h5py
import numpy as np
import pytest
import spikeserve
from beating import Robot
from policy_file import read_policy, write_policy
from security import until
from serving import DEPLOY, metric, page_of, run, running_server, series
from spikeserve.executed import SOURCES

CARTPOLE = DEPLOY / "policies/cartpole/1/policy.safetensors"
PENDULUM = DEPLOY / "policies/pendulum"
STEPS = "spikeserve_steps_total"
OBSERVATIONS = np.random.default_rng(1).normal(0, 0.05, (30, 4)).astype("f4")
# The first float32 beyond the bound of Pendulum's torque, which six digits would print as 2.
JUST_OUTSIDE = np.nextafter(np.float32(2), np.float32(3))


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Serves pendulum, and two CartPole policies that differ in their action only: `left` and `right`."""
    folder = tmp_path_factory.mktemp("policies")
    tensors, metadata = read_policy(CARTPOLE)
    for name, bias in {"left": [1e6, 0], "right": [0, 1e6]}.items():
        edited = tensors | {"head.bias": np.array(bias, "f4")}
        write_policy(folder / name / "1" / "policy.safetensors", edited, metadata)
    shutil.copytree(PENDULUM, folder / "pendulum")
    recordings = tmp_path_factory.mktemp("recordings")
    with running_server(folder, flags=[f"--record_dir={recordings}"]) as addresses:
        yield addresses, recordings


@pytest.fixture
def client(server):
    with spikeserve.Client(server[0].grpc) as opened:
        yield opened


def play(session, actions=(), retry=False):
    """Returns the cost of each decision. `actions` are executed in the place of the answers."""
    costs = []
    for step, observation in enumerate(OBSERVATIONS):
        executed = actions[step - 1] if step > 0 and len(actions) else None
        decision = session.act(observation, 1.0, executed_action=executed)
        costs.append((decision.stats.spikes_by_stage, decision.stats.multiply_accumulates))
        if retry:
            again = spikeserve.Session(session._client, session.session_id, step)
            if step > 0:
                with pytest.raises(spikeserve.FailedPreconditionError, match="executed_action: expected index 1 "):
                    again.act(observation, 1.0, executed_action=0)
            assert again.act(observation, 1.0, executed_action=executed).stats == decision.stats
    return costs


def test_the_history_holds_the_executed_action(client):
    with client.open_session("left") as left, client.open_session("right") as right:
        as_answered, expected = play(left), play(right)
    assert as_answered != expected
    with client.open_session("left") as left:
        assert play(left, actions=[1] * len(OBSERVATIONS), retry=True) == expected
    mixed = [step % 2 for step in range(len(OBSERVATIONS))]
    with client.open_session("left") as left, client.open_session("right") as right:
        assert play(left, actions=mixed) == play(right, actions=mixed)


def test_every_client_sends_it(server, client):
    with client.open_session("right") as right:
        expected = play(right)[1]

    def cost(decision):
        return decision.stats.spikes_by_stage, decision.stats.multiply_accumulates

    first, second = OBSERVATIONS[:2]
    sessions = [client.open_session("left") for _ in range(2)]
    with client.act_stream() as stream:
        stream.act(sessions[0], first)
        assert cost(stream.act(sessions[0], second, 1.0, executed_action=1)) == expected
    client.act_batch(sessions[1:], [first], [0.0])
    (batched,) = client.act_batch(sessions[1:], [second], [1.0], executed_actions=[1])
    assert cost(batched) == expected

    async def play_async():
        async with spikeserve.AsyncClient(server[0].grpc) as asynchronous:
            session = await asynchronous.open_session("left")
            await session.act(first)
            answers = [await session.act(second, 1.0, executed_action=1)]
            session = await asynchronous.open_session("left")
            async with asynchronous.act_stream() as stream:
                await stream.act(session, first)
                answers.append(await stream.act(session, second, 1.0, executed_action=1))
            return answers

    assert [cost(answer) for answer in asyncio.run(play_async())] == [expected] * 2


def test_rows_of_a_vector_environment_send_it(client):
    envs = gymnasium.make_vec("CartPole-v1", num_envs=2)
    with client.open_session("right") as right:
        expected = play(right)[1][0]
    with spikeserve.VectorSession(client, "left", envs) as rows:
        rows.act(np.stack([OBSERVATIONS[0]] * 2))
        observations = np.stack([OBSERVATIONS[1]] * 2)
        with pytest.raises(ValueError, match=r"executed_actions: expected shape \(2,\), received \(3,\)"):
            rows.act(observations, np.ones(2), executed_actions=[1, 1, 1])
        rows.act(observations, np.ones(2), executed_actions=np.array([1, 0]))
        executed, answered = rows.decisions
    assert executed.stats.spikes_by_stage == expected != answered.stats.spikes_by_stage
    envs.close()


@pytest.mark.parametrize(
    "policy, executed, message",
    [
        ("left", 2, "executed_action: expected an index from 0 to 1, received index 2"),
        ("left", -1, "executed_action: expected an index from 0 to 1, received index -1"),
        ("left", [0.5], "executed_action: expected an index from 0 to 1, received 1 continuous values"),
        ("pendulum", 1, "executed_action: expected 1 continuous values, received index 1"),
        ("pendulum", [1.0, 1.0], "executed_action: expected 1 continuous values, received 2 "),
        ("pendulum", [np.nan], r"executed_action\[0\]: expected -2 to 2, received nan"),
        ("pendulum", [np.inf], r"executed_action\[0\]: expected -2 to 2, received inf"),
        ("pendulum", [JUST_OUTSIDE], r"executed_action\[0\]: expected -2 to 2, received 2\.00000024"),
    ],
)
def test_an_action_outside_the_space_is_refused_and_changes_nothing(client, policy, executed, message):
    size = 3 if policy == "pendulum" else 4
    observation = np.full(size, 0.1)
    with client.open_session(policy) as session:
        # Step 0 has no previous action, so it ignores the field.
        session.act(observation, executed_action=executed)
        with pytest.raises(spikeserve.InvalidArgumentError, match=message):
            session.act(observation, 1.0, executed_action=executed)
        with pytest.raises(spikeserve.InvalidArgumentError, match=message):
            session.end_episode(1.0, executed_action=executed)
        assert session.state().step == 1
        assert session.act(observation, 1.0).step == 1


def test_each_step_says_who_chose_its_action(server, client, tmp_path):
    """In the recording, the metrics, the page of the session, the replay and Minari's dataset."""
    addresses, recordings = server
    Executed = spikeserve.Executed
    with client.open_session("left", spikeserve.SessionOptions(record=True)) as session:
        labels = {"policy": "left"}
        before = {source: sum(series(addresses, STEPS, source=source, **labels)) for source in SOURCES}
        told = [
            None,  # the policy, as it is the answered action
            0,  # the same
            1,  # not known
            Executed(1, "operator", "anna"),
            Executed(0, "operator"),  # agrees
            Executed(1, "safety_layer"),
            Executed(1, "policy"),  # an older answer
        ]
        session.act(OBSERVATIONS[0])
        for step, executed in enumerate(told):
            session.act(OBSERVATIONS[step + 1], 1.0, executed_action=executed)
        page = json.loads(page_of(addresses, f"/session.json?session={session.session_id}"))
        assert page["last_source"] == "policy"
        session.end_episode(1.0, executed_action=Executed(1, "operator", "Åsa"))
        page = json.loads(page_of(addresses, f"/session.json?session={session.session_id}"))
        assert page["last_source"] == "operator:Åsa"
    sources = "policy policy unknown operator:anna operator safety_layer policy operator:Åsa".split()
    path = recordings / session.opening.recording / "000000.cbor"
    until(path.exists)
    served = cbor2.loads(path.read_bytes())["episodes"][0]["served"]
    assert served["sources"] == sources
    for source, count in before.items():
        expected = sum(text.partition(":")[0] == source for text in sources)
        assert metric(addresses, STEPS, source=source, **labels) == count + expected, source
    replay = run("spikectl", "replay", f"--recording={path}", f"--server={addresses.grpc}", "--json")
    assert json.loads(replay.stdout)["steps_by_source"]["operator:anna"] == 1
    if "SPIKETRAIN_PROGRAM" in os.environ:
        run("spiketrain", "dataset", f"--recordings={path.parent}", f"--out={tmp_path}/served-v0")
        with h5py.File(tmp_path / "served-v0/data/main_data.hdf5") as file:
            written = file["episode_0/infos/source"][:].tolist()
        assert [SOURCES[kind] for kind in written[:-1]] == [text.partition(":")[0] for text in sources]
        convert = ("spiketrain", "dataset", f"--recordings={path.parent}", f"--out={tmp_path}/weighted.cbor")
        weights = {"operator": 10.0, "policy": 0.5}
        summary = run(*convert, "--correction_weight=10", "--policy_weight=0.5").stdout
        assert json.loads(summary)["corrected_steps"] == 3
        written = cbor2.loads((tmp_path / "weighted.cbor").read_bytes())["episodes"][0]["weights"]
        assert list(written) == [weights.get(text.partition(":")[0], 0.0) for text in sources]
        for value in ("-1", "nan", "2e6"):
            refused = run(*convert, f"--correction_weight={value}", status=1).stderr
            assert refused.startswith("spiketrain: --correction_weight: expected ")


@pytest.mark.parametrize(
    "source, message",
    [
        ({"kind": 8}, "executed_source.kind: expected 0 to 7, received 8"),
        ({"kind": -1}, "executed_source.kind: expected 0 to 7, received -1"),
        ({"kind": 2, "operator_id": "x" * 129}, "operator_id: expected at most 128 bytes from operator, received 129"),
        ({"kind": 1, "operator_id": "x"}, "operator_id: expected at most 0 bytes from policy, received 1"),
        ({"operator_id": "x"}, "operator_id: expected at most 0 bytes from unknown, received 1"),
    ],
)
def test_a_source_that_is_none_is_refused_and_changes_nothing(server, source, message):
    service = server[0].agent
    robot = Robot(service, policy="left")
    robot.act()
    executed = {"executed_action": {"discrete": 1}, "executed_source": source}
    robot.is_refused(robot.request(**executed), message)
    ended = {"session_id": robot.id, "reward": 0.0, **executed}
    with pytest.raises(grpc.RpcError, match=message):
        service.EndEpisode(**ended)
    beats = [dict(robot.beats[0], source=source)]
    robot.is_refused(robot.request(history=1) | {"history": beats}, rf"history\[0\]: .*{message}")
    without = robot.request(executed_source={"kind": 2})
    robot.is_refused(without, "executed_action: expected an index from 0 to 1, received none")


def test_what_is_no_action_is_refused_before_it_is_sent(client):
    with client.open_session("pendulum") as session:
        session.act(np.zeros(3))
        for executed in (1.5, [[1.0]]):
            with pytest.raises(ValueError, match="executed_action: expected an integer or an array"):
                session.act(np.zeros(3), 0.0, executed_action=executed)


@pytest.mark.parametrize("sample", [False, True])
def test_recordings_hold_it_and_replay_honours_it(server, client, tmp_path, sample):
    addresses, recordings = server
    options = spikeserve.SessionOptions(record=True, sample=sample, seed=5)
    answered, executed = [], []
    with (
        client.open_session("pendulum", options) as session,
        gymnasium.make("Pendulum-v1", max_episode_steps=60) as environment,
    ):
        recording = session.opening.recording
        for episode in range(2):
            observation, _ = environment.reset(seed=episode)
            reward, over, torque = 0.0, False, None
            while not over:
                answered.append(session.act(observation, reward, executed_action=torque).action)
                torque = np.clip(answered[-1], -0.7, 0.7)  # the safety layer
                executed.append(torque)
                observation, reward, terminated, over, _ = environment.step(torque)
            session.end_episode(reward, terminated, over, executed_action=torque)
    assert not np.array_equal(answered, executed)

    folder = recordings / recording
    until(lambda: len(list(folder.glob("*.cbor"))) == 2)  # another thread of the server writes the episodes
    replay = run("spikectl", "replay", f"--recording={folder}", f"--server={addresses.grpc}", "--json")
    result = json.loads(replay.stdout)
    assert result["identical"] and result["decisions"] == len(answered)
    if "SPIKETRAIN_PROGRAM" in os.environ:
        out = tmp_path / "served.cbor"
        run("spiketrain", "dataset", f"--recordings={folder}", f"--out={out}")
        content = out.read_bytes()
        assert np.array(0.7, ">f4").tobytes() in content
        assert b"answered_actions" in content
