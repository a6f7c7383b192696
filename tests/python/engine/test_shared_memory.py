"""Processes that name one folder have the weight matrices of a policy once in memory, and decide as without it."""

import os
import pathlib
import re
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import spikeserve_engine
from random_policy import export_random
from serving import SHIPPED_POLICIES

PROCESSES = 20
CARTPOLE = SHIPPED_POLICIES / "cartpole/1/policy.safetensors"
# Plays, says so, and waits with the policy in memory until its input ends.
PLAY = """
import sys
import spikeserve_engine
path, folder = sys.argv[1], sys.argv[2] or None
engine = spikeserve_engine.Engine(path, shared_memory=folder)
session = engine.session()
print([session.act([0.1, 0.2, 0.3, 0.4], 1.0).logits.tolist() for _ in range(3)], flush=True)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def large_policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    shape = {"mode": "full", "hidden_size": 512, "heads": 4, "ffn_size": 2048, "layers": 2}
    export_random(folder, "large", gymnasium.make("CartPole-v1"), **shape)
    return folder / "large/1/policy.safetensors"


def proportional_bytes(pid):
    """Returns the memory of a process, in which a page of n processes counts as the n-th part of a page."""
    rollup = pathlib.Path(f"/proc/{pid}/smaps_rollup").read_text()
    return 1024 * int(re.search(r"^Pss:\s+(\d+) kB", rollup, re.MULTILINE).group(1))


def play_in_processes(path, folder):
    """Returns what the processes decide, and their memory together while all of them hold the policy."""
    command = [sys.executable, "-c", PLAY, str(path), str(folder)]
    started = []
    try:
        for _ in range(PROCESSES):
            started.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        decisions = [process.stdout.readline() for process in started]
        return decisions, sum(proportional_bytes(process.pid) for process in started)
    finally:
        for process in started:
            process.communicate()


def test_twenty_processes_share_the_weights_of_one_policy(large_policy, tmp_path):
    separate_decisions, separate = play_in_processes(large_policy, "")
    shared_decisions, shared = play_in_processes(large_policy, tmp_path / "shared")
    assert shared_decisions == separate_decisions
    assert len(set(shared_decisions)) == 1
    size = large_policy.stat().st_size
    print(f"policy {size >> 20} MiB, {PROCESSES} processes: {separate >> 20} MiB, shared {shared >> 20} MiB")
    # Each process alone has the matrices at least once.
    assert separate - shared > 0.9 * (PROCESSES - 1) * size
    (file,) = (tmp_path / "shared").iterdir()
    assert 0.95 * size < file.stat().st_size < 1.1 * size


def decide(engine):
    session = engine.session(learning=spikeserve_engine.Learning(rule="hebbian"))
    random = np.random.default_rng(0)
    logits = [session.act(random.normal(0, 1, 4), 1.0).logits for _ in range(30)]
    return np.concatenate(logits).tolist(), session.explain().logits.tolist()


@pytest.mark.parametrize("version", [1, 2])
def test_decisions_and_explanations_are_those_of_an_engine_of_its_own(version, tmp_path):
    path = SHIPPED_POLICIES / f"cartpole/{version}/policy.safetensors"
    expected = decide(spikeserve_engine.Engine(path))
    for _ in range(2):  # writes the file, and finds it
        assert decide(spikeserve_engine.Engine(path, shared_memory=tmp_path / "shared")) == expected


def test_a_replaced_policy_file_changes_nothing_that_plays(tmp_path):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(CARTPOLE.read_bytes())
    engine = spikeserve_engine.Engine(path, shared_memory=tmp_path / "shared")
    expected = decide(engine)
    other = tmp_path / "other"
    other.write_bytes((SHIPPED_POLICIES / "acrobot/1/policy.safetensors").read_bytes())
    other.rename(path)
    for file in (tmp_path / "shared").iterdir():
        file.unlink()
    assert decide(engine) == expected


def test_a_truncated_policy_file_fails_only_what_reads_it_again(tmp_path):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(CARTPOLE.read_bytes())
    session = spikeserve_engine.Engine(path, shared_memory=tmp_path / "shared").session()
    session.act([0.1, 0.2, 0.3, 0.4])
    with path.open("r+b") as file:
        file.truncate(1000)
    session.act([0.1, 0.2, 0.3, 0.4], 1.0)
    with pytest.raises(RuntimeError, match="expected the content that the engine plays, received other content"):
        session.explain()


@pytest.mark.parametrize("damage", [lambda content: content[:-1], lambda content: bytes([content[0] ^ 1]) + content[1:]])
def test_a_damaged_shared_file_is_replaced(damage, tmp_path):
    engine = spikeserve_engine.Engine(CARTPOLE, shared_memory=tmp_path)
    (file,) = tmp_path.iterdir()
    content = file.read_bytes()
    assert file.stat().st_mode & 0o777 == 0o400
    damaged = tmp_path / "damaged"
    damaged.write_bytes(damage(content))
    damaged.rename(file)
    assert decide(spikeserve_engine.Engine(CARTPOLE, shared_memory=tmp_path)) == decide(engine)
    assert file.read_bytes() == content
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_that_others_can_write_is_refused(tmp_path):
    tmp_path.chmod(0o777)
    with pytest.raises(ValueError, match="expected a folder that only this user can write, received mode 777"):
        spikeserve_engine.Engine(CARTPOLE, shared_memory=tmp_path)
    with pytest.raises(ValueError, match="expected a folder that only this user can write, received a file"):
        spikeserve_engine.Engine(CARTPOLE, shared_memory=CARTPOLE)
    with pytest.raises(FileNotFoundError, match="cannot create the folder"):
        spikeserve_engine.Engine(CARTPOLE, shared_memory=tmp_path / "a" / "b")


def test_a_dense_policy_is_refused(tmp_path):
    export_random(tmp_path, "dense", gymnasium.make("CartPole-v1"), mode="dense")
    with pytest.raises(ValueError, match="mode: expected a spiking policy, received dense"):
        spikeserve_engine.Engine(tmp_path / "dense/1/policy.safetensors", shared_memory=tmp_path / "shared")
    assert not os.path.exists(tmp_path / "shared")
