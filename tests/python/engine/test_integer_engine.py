"""Policies in integer arithmetic give the spikes and readouts that docs/design/integer.md gives in NumPy."""

import json

import gymnasium
import numpy as np
import pytest
from integer_engine import IntegerEngine
from operation_count import DenseEngine
from policy_file import read_policy
from random_policy import export_random
from serving import SHIPPED_POLICIES, run, running_server

STEPS = 24  # longer than the context
CASES = [  # environment, config, mode of the integer policy
    ("CartPole-v1", {"mode": "full"}, "full"),
    ("Pendulum-v1", {"mode": "full", "ticks": 10}, "baseline"),
    ("Acrobot-v1", {"mode": "full", "ticks": 10, "layers": 3}, "full"),
    ("CartPole-v1", {"mode": "full", "gate": "sigmoid"}, "route"),
    ("Pendulum-v1", {"mode": "pos", "ticks": 1, "merge": "concat"}, "pos"),
    ("CartPole-v1", {"mode": "full", "phase_clock": "window"}, "pos"),
    ("CartPole-v1", {"mode": "baseline", "membrane_decay": 1.0, "observation_changes": True}, "baseline"),
    ("CartPole-v1", {"mode": "pos", "hidden_size": 64, "heads": 8, "ticks": 1, "context": 9}, "pos"),
    ("MountainCar-v0", {"mode": "full"}, "baseline"),
    ("CartPole-v1", {"mode": "full", "norm": "none"}, "full"),  # residuals reach their limits
]
SHIPPED = sorted(SHIPPED_POLICIES.glob("*/*/policy.safetensors"))


def decide(*arguments, lines=(), status=0):
    """Runs the program with a policy, or with one, the file to write it to as integers, and its mode."""
    text = "".join(json.dumps(line) + "\n" for line in lines)
    return run("integer_decisions", *arguments, input=text, status=status)


def episode(tensors, action_size):
    random = np.random.default_rng(1)
    mean, std = tensors["observation.mean"], tensors["observation.std"]
    for step in range(STEPS):
        line = {"return_to_go": float(np.float32(100 * random.normal()))}
        observation = mean + 1.5 * std * random.normal(size=len(mean))
        line["observation"] = [float(x) for x in observation.astype(np.float32)]
        if step > 0:
            line["last_action"] = [float(x) for x in np.eye(action_size)[random.integers(action_size)]]
        yield line


def check_decisions(policy, lines, answers):
    """Compares answers of the program with those of the page's engine, which reads the same file."""
    engine = IntegerEngine(*read_policy(policy))
    total = 0
    for step, (line, answer) in enumerate(zip(lines, answers.splitlines(), strict=True)):
        actual = json.loads(answer)
        spikes, readout = engine.decide(line["return_to_go"], line["observation"], line.get("last_action"))
        assert actual["spikes"] == spikes, f"step {step}"
        np.testing.assert_array_equal(np.array(actual["readout"], np.float32), readout)
        total += sum(spikes.values())
    assert total > 0
    return engine


@pytest.mark.parametrize(("environment", "config", "mode"), CASES)
def test_every_decision_is_that_of_the_page(tmp_path, environment, config, mode):
    export_random(tmp_path, "random", gymnasium.make(environment), **config)
    source, target = tmp_path / "random/1/policy.safetensors", tmp_path / "integer.safetensors"
    tensors, _ = read_policy(source)
    lines = list(episode(tensors, len(tensors["head.bias"])))
    result = decide(source, target, mode, lines=lines)
    assert check_decisions(target, lines, result.stdout).config["mode"] == mode


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: "/".join(path.parts[-3:-1]))
def test_every_decision_of_a_shipped_policy_is_that_of_the_page(path):
    tensors, _ = read_policy(path)
    lines = list(episode(tensors, len(tensors["head.bias"])))
    result = decide(path, lines=lines)
    check_decisions(path, lines, result.stdout)


@pytest.mark.parametrize("sizes", [{}, {"hidden_size": 48, "heads": 6, "layers": 3, "context": 3, "ffn_size": 40}])
def test_a_dense_decision_is_that_of_the_page(tmp_path, sizes):
    export_random(tmp_path, "dense", gymnasium.make("CartPole-v1"), mode="dense", **sizes)
    tensors, _ = read_policy(tmp_path / "dense/1/policy.safetensors")
    target = tmp_path / "integer.safetensors"
    lines = list(episode(tensors, 2))
    result = decide(tmp_path / "dense/1/policy.safetensors", target, "dense", lines=lines)
    engine = DenseEngine(*read_policy(target))
    readouts = []
    for step, (line, answer) in enumerate(zip(lines, result.stdout.splitlines(), strict=True)):
        actual = json.loads(answer)
        readout = engine.decide(line["return_to_go"], line["observation"], line.get("last_action"))
        np.testing.assert_array_equal(np.array(actual["readout"], np.float32), readout, err_msg=f"step {step}")
        assert actual["joules"]["int_45nm"] == pytest.approx(engine.operations_joules(), rel=1e-9)
        assert actual["joules"]["int_sram_45nm"] == pytest.approx(engine.joules_with_memory(), rel=1e-9)
        readouts.append(readout)
    assert np.std(readouts, axis=0).max() > 0.1


def export(folder, **config):
    export_random(folder, "random", gymnasium.make("CartPole-v1"), **config)
    return folder / "random/1/policy.safetensors"


def test_a_part_that_the_policy_lacks_is_refused(tmp_path):
    source = export(tmp_path, mode="baseline")
    result = decide(source, tmp_path / "integer.safetensors", "full", status=1)
    assert "mode: expected one whose parts mode baseline has, received full" in result.stderr
    assert not (tmp_path / "integer.safetensors").exists()


def test_a_server_serves_and_explains_it(tmp_path):
    target = tmp_path / "policies/integers/1/policy.safetensors"
    target.parent.mkdir(parents=True)
    decide(export(tmp_path), target, "full")
    tensors, metadata = read_policy(target)
    engine = IntegerEngine(tensors, metadata)
    last_action = None
    with running_server(tmp_path / "policies") as addresses:
        session = addresses.agent.OpenSession(policy="integers").session_id
        for step, line in enumerate(episode(tensors, 2)):
            answer = addresses.agent.Act(session_id=session, step=step, observation=line["observation"], reward=1.0)
            spikes, _ = engine.decide(answer.return_to_go, line["observation"], last_action)
            stages = answer.stats.spikes_by_stage
            assert {stage: getattr(stages, stage) for stage in spikes} == spikes, f"step {step}"
            assert 0 < answer.stats.energy_joules < 1e-6
            last_action = np.eye(2)[answer.action.discrete]
        explained = addresses.agent.Explain(session_id=session)
        assert explained.answer.stats.spikes == sum(spikes.values())
