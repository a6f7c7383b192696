"""The page "On a microcontroller", as printed: physics here, policies in QEMU, and the returns of the engine in Python."""

import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import spikeserve_engine
from emitted import ROOT, SPIKECTL

PAGE = ROOT / "docs/guides/microcontroller.md"
SMALLEST = "--steps=1500 --environments=3 --hidden-size=16 --context=4 --train-flags=--heads=2 --batch=8 --iterations=40 --rounds=0"


def follow(folder, edits=()):
    """Runs the commands of the page in a folder that looks like a checkout, and returns what they print."""
    commands = "\n".join(re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL))
    for old, new in edits:
        assert old in commands
        commands = commands.replace(old, str(new))
    for name in ("deploy", "examples"):
        (folder / name).symlink_to(ROOT / name)
    path = f"{Path(SPIKECTL).parent}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-e", "-c", commands], cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def on_the_engine(file, environment):
    """Returns what play.py prints, of the engine in Python."""
    environment, session = gymnasium.make(environment), spikeserve_engine.Engine(file).session()
    observation, _ = environment.reset(seed=0)
    reward, total, ended = 0.0, 0.0, False
    while not ended:
        action = session.act(observation, float(reward)).action
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, ended = total + float(reward), terminated or truncated
    return f"mean return {total:.1f}\n"


def test_cart_pole(tmp_path):
    printed = follow(tmp_path)
    assert printed.startswith(re.search(r"^cartpole-small.*", printed)[0])
    assert printed.endswith("mean return 500.0\n")
    tables, state = re.search(r"(\d+) bytes of tables.* (\d+) bytes of state", printed).groups()
    assert f"{int(tables):,} bytes of tables for the flash, and a state of {int(state):,}" in " ".join(
        PAGE.read_text().split()
    )


def test_pendulum(tmp_path):
    """A policy of the paper's size, whose actions are numbers."""
    edits = [("policies/cartpole-small/1", "policies/pendulum/1"), ("CartPole-v1", "Pendulum-v1")]
    file = ROOT / "deploy/policies/pendulum/1/policy.safetensors"
    assert follow(tmp_path, edits).endswith(on_the_engine(file, "Pendulum-v1"))


def test_a_policy_of_ones_own(tmp_path):
    """What `imitate` writes goes to the chip with the commands of the page."""
    expert = "--expert=home_made:balance"
    command = [sys.executable, "-m", "spikeserve", "imitate", "CartPole-v1", expert, "--out=own", *SMALLEST.split()]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}  # of the module home_made
    short = ["--silence=3:15", "--silence-iterations=2", "--tolerance=10", "--selection-episodes=3", "--episodes=4"]
    subprocess.run([*command, *short], cwd=tmp_path, env=environment, check=True)
    file = tmp_path / "own/policies/cartpole/2/policy.safetensors"
    printed = follow(tmp_path, [("deploy/policies/cartpole-small/1/policy.safetensors", file)])
    assert printed.endswith(on_the_engine(file, "CartPole-v1"))


def test_an_emulator_that_ends_is_no_endless_wait(tmp_path):
    qemu = tmp_path / "qemu-system-arm"
    for ending in ("exit 1", "head -c 1"):  # before and after the observation
        qemu.write_text(f"#!/bin/sh\n{ending}\n")
        qemu.chmod(0o755)
        command = [sys.executable, ROOT / "examples/microcontroller/play.py", "CartPole-v1", "1", "policy.elf"]
        path = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
        done = subprocess.run(command, env=os.environ | path, capture_output=True, text=True, timeout=120)
        assert (done.returncode, done.stderr) == (1, "play.py: expected an action, received the end of policy.elf\n")
