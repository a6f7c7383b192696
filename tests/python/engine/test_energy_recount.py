"""A recount in Python, operation by operation and byte by byte, gives the energies that a server answers with."""

import os
import subprocess

import gymnasium
import numpy as np
import pytest
from operation_count import CountedIntegerEngine
from policy_file import read_policy, without_norms, write_policy
from serving import RELEASED_POLICIES, running_server

PROGRAM = os.environ["INTEGER_DECISIONS_PROGRAM"]
STEPS = 30  # longer than the context
CARTPOLE = RELEASED_POLICIES / "cartpole-sparse"
NAMES = ("integer", "no-norms")


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """Writes CartPole's policy in integers, with its norms and without. Returns the folder."""
    folder = tmp_path_factory.mktemp("policies")
    for name in NAMES:
        (folder / name / "1").mkdir(parents=True)
    stripped = folder.parent / "float32-no-norms/policy.safetensors"
    write_policy(stripped, *without_norms(*read_policy(CARTPOLE / "1/policy.safetensors")))
    for name, source in (("integer", CARTPOLE / "1/policy.safetensors"), ("no-norms", stripped)):
        target = folder / name / "1/policy.safetensors"
        command = [PROGRAM, str(source), str(target), "full"]
        subprocess.run(command, stdin=subprocess.DEVNULL, check=True, timeout=120)
    return folder


@pytest.fixture(scope="module")
def service(policies):
    with running_server(policies) as addresses:
        yield addresses.agent


@pytest.mark.parametrize("name", NAMES)
def test_the_energies_are_those_of_a_recount(policies, service, name):
    engine = CountedIntegerEngine(*read_policy(policies / name / "1/policy.safetensors"))
    environment = gymnasium.make("CartPole-v1")
    observation, _ = environment.reset(seed=1)
    session = service.OpenSession(policy=name).session_id
    last_action = None
    for step in range(STEPS):
        answer = service.Act(session_id=session, step=step, observation=observation.tolist(), reward=float(step > 0))
        engine.decide(answer.return_to_go, observation, last_action)
        stats = answer.stats
        assert stats.int_energy_joules == pytest.approx(engine.operations_joules(), rel=1e-9), f"step {step}"
        assert stats.int_sram_energy_joules == pytest.approx(engine.joules_with_memory(), rel=1e-9), f"step {step}"
        last_action = np.eye(2)[answer.action.discrete]
        observation, *_ = environment.step(answer.action.discrete)
