"""Runs the commands of documentation pages, in order, in an empty directory."""

import json
import os
import pathlib
import re

import pytest
from documentation import Shell, files_of
from links import Link
from serving import run

ROOT = pathlib.Path(__file__).parents[3]


@pytest.fixture
def shell(tmp_path):
    with Shell(tmp_path) as started:
        yield started


def check_policies(shell, directory):
    *_, rollout, history, drained = shell.run("guides/policies.md")
    assert "cartpole/2: cancelled at 1 % (steps 1,10,50,100)" in rollout
    assert "AbortRollout by " in history
    assert drained == "draining, open sessions: 0\nserving, open sessions: 0\n"
    assert sorted(path.name for path in (directory / "my-policies/cartpole").iterdir()) == ["1", "2"]
    assert [path.name for path in (directory / "my-policies/cartpole/1").iterdir()] == ["policy.safetensors"]


def test_serve_your_own_policy(shell, tmp_path):
    check_policies(shell, tmp_path)


def check_security(shell):
    _, over_tls, _, with_tokens = shell.run("security.md")
    assert "cartpole-small" in over_tls
    assert over_tls.endswith("SERVING\n")
    assert "mean return" in with_tokens
    status = json.loads(with_tokens[with_tokens.index("{") :])
    assert status["serving"] is True


def test_secure_it(shell, tmp_path):
    before = set(tmp_path.iterdir())
    check_security(shell)
    # A newcomer runs the page in a checkout, and nobody wants to commit a key.
    made = {path.name for path in set(tmp_path.iterdir()) - before}
    assert {"ca.key", "operator.token", "tokens.json"} <= made
    ignored = run("git", "check-ignore", *made, status=None, cwd=ROOT).stdout.split()
    assert set(ignored) == made


def test_web_pages(shell):
    (answer,) = shell.run("grpc-web.md")
    assert answer == "grpc-status: 0\n"


def check_recording(shell, directory):
    recordings = directory / "recordings"
    # The server writes an episode after it has answered, so replay waits for the third file.
    wait = f"until ls {recordings}/*/000002.cbor >{directory}/listed 2>&1; do :; done"
    edits = [
        ("spikectl replay", f"{wait}\nspikectl replay"),
        ("/tmp/recordings", str(recordings)),
        ("--iterations=300", "--iterations=1"),
    ]
    _, played, replayed, trained = shell.run("recording.md", edits)
    assert "mean return 500.0" in played
    assert "1500 decisions of 3 episodes, all equal bit for bit" in replayed
    assert "policy: retrained/policy.safetensors" in trained
    assert "target return: 500, the default for CartPole-v1" in trained
    served = directory / "retrained-policies/cartpole"
    assert sorted(str(path.relative_to(served)) for path in served.rglob("*.safetensors")) == [
        "1/policy.safetensors",
        "2/policy.safetensors",
    ]


def test_is_my_robot_wired_right(shell, tmp_path):
    (tmp_path / "robot.py").write_text(files_of("wiring.md")["robot.py"])
    listed = "spikectl doctor"
    # The server writes an episode after it has answered.
    wait = f"until [ $(ls {tmp_path}/recordings/*/000000.cbor 2>/dev/null | wc -l) = 2 ]; do :; done\n{listed}"
    _, features, played = shell.run("wiring.md", [(listed, wait)])
    assert "cartpole/2 at 50 Hz within 10 %\n  observation[0] cart_position m from -4.8 to 4.8 in track\n" in features
    named, unnamed, *table = played.splitlines()
    verdict = "observation[1] (cart_velocity) and observation[2] (pole_angle) look exchanged"
    assert named.split() == ["return", "500.0"]
    assert unnamed.endswith(verdict)
    assert table[-1].endswith(verdict)


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_record_and_retrain(shell, tmp_path):
    check_recording(shell, tmp_path)


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_pages_do_not_disturb_each_other(shell, tmp_path):
    """Walks the pages one after the other in one directory, each of them twice."""
    for _ in range(2):
        check_policies(shell, tmp_path)
        served = (tmp_path / "my-policies/cartpole/2/policy.safetensors").read_bytes()
        check_recording(shell, tmp_path)
        assert (tmp_path / "my-policies/cartpole/2/policy.safetensors").read_bytes() == served
        check_security(shell)


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_from_a_bad_robot_to_a_better_version(shell, tmp_path):
    (tmp_path / "robot.py").write_text(files_of("corrections.md")["robot.py"])
    dataset = "spiketrain dataset"
    # The server writes an episode after it has answered.
    wait = f"until ls {tmp_path}/recordings/*/000009.cbor >{tmp_path}/listed 2>&1; do :; done\n{dataset}"
    _, played, trained, pushed = shell.run("guides/corrections.md", [(dataset, wait)])
    bad, operated = (float(line.split()[-1]) for line in played.splitlines())
    assert bad < 15 and operated > 400
    recipe = json.loads(trained.splitlines()[0])
    assert recipe["corrected_steps"] == 10 * (operated - 5)
    assert "version 2: mean return" in pushed
    better = float(pushed.splitlines()[-1].split()[-1])
    assert better > 10 * bad


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_from_data_to_a_robot_that_learns(tmp_path):
    """docs/start/your-robot.md, as a reader does it, with the robot far away."""
    files = files_of("your-robot.md")
    assert list(files) == ["quad.py", "record.py", "fly.py"]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with Shell(tmp_path) as shell:
        # The robot is 50 ms away, and of the segments 1 % are lost.
        with Link(target=None, delay=0.025, loss=0.01) as link:
            # Each block has a shell of its own here, so the variable of an earlier block is set again.
            commands = [("python fly.py", f"SPIKESERVE_SERVER={link.address} python fly.py")]
            outputs = []
            for output in shell.run("your-robot.md", commands):
                outputs.append(output)
                link.target = shell.server
        _, _, evaluated, flown, watched, learned = outputs
    mean_return = float(re.search(r"quad/1 plays Quad-v0: return (-\d+\.\d)", evaluated)[1])
    assert mean_return > -40  # without torques: -81
    # All beats of both episodes are in the session, whoever has chosen their actions, and each is there once.
    returns = re.findall(r"episode \d: return (-\d+\.\d) in 200 beats", flown)
    assert len(returns) == 2, flown
    beats, *sources = map(int, re.search(r"(\d+) beats: (\d+) fresh, (\d+) held, (\d+) local, (\d+) safe", flown).groups())
    assert beats == 400 == sum(sources)
    assert sources[0] > 0
    elements = re.findall(r'unusual_observations_total\{element="(\d+)",policy="quad"', watched)
    assert sorted(map(int, elements)) == list(range(12))
    assert re.search(r"quad/1: drift 0\.\d+, 2 updates, 0 refused, 0 rollbacks", learned), learned
