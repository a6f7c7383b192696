"""The server recognises a robot whose elements are wired otherwise than those of the training data."""

import contextlib
import json

import gymnasium
import numpy as np
import pytest
import spikeserve
from cpp_pilot import CppPilot
from restartable_server import restartable_server
from security import until
from serving import SHIPPED_POLICIES, metric, page_of, refusal_at_start, run, running_server
from spikeserve.conversion import Selection, convert

STEPS = 50


def exchange(i, j):
    def wire(observation):
        wired = observation.copy()
        wired[[i, j]] = wired[[j, i]]
        return wired

    return wire


def negate(i):
    def wire(observation):
        return observation * np.where(np.arange(len(observation)) == i, -1, 1)

    return wire


def right(observation):
    return observation


def play(session, environment, wire, steps=STEPS, seed=0):
    """Plays up to `steps` steps, over as many episodes as that takes. Returns the last decision."""
    observation, _ = environment.reset(seed=seed)
    reward, decision = 0.0, None
    for _ in range(steps + 1):
        decision = session.act(wire(observation), reward)
        observation, reward, terminated, truncated, _ = environment.step(decision.action)
        if terminated or truncated:
            session.end_episode(reward, terminated, truncated)
            observation, _ = environment.reset()
            reward = 0.0
    return decision


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def server(recordings):
    flags = [f"--record_dir={recordings}", "--wiring=count,pendulum=safe"]
    with running_server(flags=flags) as addresses:
        yield addresses


@pytest.fixture
def client(server):
    with spikeserve.Client(server.grpc) as opened:
        yield opened


@pytest.mark.parametrize(
    ("wire", "text"),
    [
        (exchange(1, 2), "observation[1] (cart_velocity) and observation[2] (pole_angle) look exchanged"),
        (negate(3), "observation[3] (pole_angular_velocity) looks as if it had the other sign"),
        (lambda x: x * [1, 1, 57.29578, 1], "observation[2] (pole_angle) looks like degrees, expected radians"),
    ],
)
def test_a_wrong_wiring_is_named_in_answers_metrics_and_on_the_page(server, client, wire, text):
    with client.open_session("cartpole") as session:
        decision = play(session, gymnasium.make("CartPole-v1"), wire)
        assert decision.wiring.text == text
        assert not decision.wiring.is_safe_action
        assert session.state().wiring.text == text
        assert text in page_of(server, f"/session.json?session={session.session_id}")
    assert metric(server, "spikeserve_wiring_verdicts_total", policy="cartpole") >= 1


def test_a_robot_that_is_wired_right_gets_no_verdict(client):
    for policy, task in (("cartpole", "CartPole-v1"), ("pendulum", "Pendulum-v1"), ("acrobot", "Acrobot-v1")):
        with client.open_session(policy) as session:
            for seed in range(3):
                assert play(session, gymnasium.make(task), right, 200, seed).wiring is None


def test_a_policy_that_acts_safely_takes_the_neutral_action_until_the_wiring_is_right(client):
    environment = gymnasium.make("Pendulum-v1")
    with client.open_session("pendulum") as session:
        decision = play(session, environment, negate(1))
        assert decision.wiring.is_safe_action
        assert decision.action.tolist() == [0.0]
        decision = play(session, environment, right, 150)
        assert decision.wiring is None


def play_safely(folder, deaths):
    """Plays Pendulum with a wrong sign and then with the right one. Kills the server before the steps `deaths`."""
    environment = gymnasium.make("Pendulum-v1")
    observation, _ = environment.reset(seed=5)
    reward, answers = 0.0, []
    options = spikeserve.SessionOptions(wiring="SAFE", durability="SYNC")
    with (
        restartable_server(f"--session_store=file:{folder}") as server,
        spikeserve.Client(server.address) as client,
        client.open_session("pendulum", options) as session,
    ):
        for step in range(120):
            if step in deaths:
                server.kill()
                server.start()
            decision = session.act((negate(1) if step < 40 else right)(observation), reward)
            answers.append((decision.action.tolist(), decision.wiring))
            observation, reward, *_ = environment.step(decision.action)
    return answers


def test_verdict_and_safe_action_survive_a_killed_server(tmp_path):
    steady = play_safely(tmp_path / "steady", deaths=())
    safe = [step for step, (_, wiring) in enumerate(steady) if wiring is not None]
    assert safe and safe[-1] < 119
    assert all(steady[step][0] == [0.0] for step in safe)
    assert play_safely(tmp_path / "killed", deaths=(2, 5, safe[0] + 1, 30, 45, safe[-1])) == steady


def test_a_session_chooses_what_follows(client):
    with client.open_session("pendulum", spikeserve.SessionOptions(wiring="COUNT")) as session:
        decision = play(session, gymnasium.make("Pendulum-v1"), negate(1))
        assert decision.wiring.cause == "SIGN" and not decision.wiring.is_safe_action


@pytest.mark.parametrize("make", [spikeserve.Pilot, CppPilot])
def test_a_pilot_takes_its_safe_step(server, make):
    environment = gymnasium.make("Pendulum-v1")
    options = {"period": 0.5, "max_age": 60.0, "local": False, "ramp_beats": 0}
    with spikeserve.Client(server.grpc) as client, contextlib.closing(make(client, "pendulum", **options)) as pilot:
        observation, _ = environment.reset(seed=1)
        beat = None
        for _ in range(STEPS):
            beat = pilot.beat(negate(1)(observation), 0.0)
            observation = environment.step(beat.action)[0]
        assert beat.source == "safe" and beat.action.tolist() == [0.0]


def test_the_doctor_names_what_a_recording_and_a_session_show(server, client, recordings):
    with client.open_session("cartpole", spikeserve.SessionOptions(record=True)) as session:
        play(session, gymnasium.make("CartPole-v1"), exchange(0, 2))
        session.end_episode(0.0, truncated=True)
        live = doctor(server, f"--session={session.session_id}")
        episodes = session.state().episode
    folder = recordings / session.opening.recording
    until(lambda: len(list(folder.glob("*.cbor"))) == episodes)
    recorded = doctor(server, "--policy=cartpole", f"--observations={folder}")
    for text in (live, recorded):
        assert "observation[0] (cart_position) and observation[2] (pole_angle) look exchanged" in text
    assert "pole_angular_velocity    rad/s" in recorded


def doctor(server, *flags, status=0):
    done = server.spikectl("doctor", *flags, status=status)
    return done.stderr if status else done.stdout


def test_data_of_lerobot_in_another_order_are_refused_by_name(server, client, recordings, tmp_path):
    with client.open_session("cartpole", spikeserve.SessionOptions(record=True)) as session:
        play(session, gymnasium.make("CartPole-v1"), right)
        session.end_episode(0.0, truncated=True)
    folder = recordings / session.opening.recording
    until(lambda: list(folder.glob("*.cbor")))
    convert(folder, tmp_path / "set", "lerobot", selection=Selection(fps=50))
    info = tmp_path / "set/meta/info.json"
    described = json.loads(info.read_text())
    for order in ([0, 1, 2, 3], [0, 2, 1, 3]):
        names = described["features"]["observation.state"]["names"]
        described["features"]["observation.state"]["names"] = [names[i] for i in order]
        info.write_text(json.dumps(described))
        convert(tmp_path / "set", tmp_path / f"{order[1]}.cbor", "spikeserve")
    assert "wired right" in doctor(server, "--policy=cartpole", f"--observations={tmp_path}/1.cbor")
    refusal = (
        f'{tmp_path}/2.cbor: observation_names[1]: expected "cart_velocity", received "pole_angle"; '
        "the policy's order is [0, 2, 1, 3] of the received elements"
    )
    assert refusal in doctor(server, "--policy=cartpole", f"--observations={tmp_path}/2.cbor", status=1)
    shipped = SHIPPED_POLICIES / "cartpole/2/policy.safetensors"
    flags = (f"--policy={shipped}", f"--data={tmp_path}/2.cbor", f"--out={tmp_path}/out")
    assert refusal in run("spikectl", "policy", "annotate", *flags, status=1).stderr
    assert not (tmp_path / "out").exists()


def test_rules_are_refused_by_the_flag():
    assert "--wiring: expected count, warn or safe" in refusal_at_start("--wiring=arm=stop")
