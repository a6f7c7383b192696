"""The page "On a microcontroller", as printed, and another task on the same chip: the physics are here, the policy is in QEMU."""

import os
import re
import subprocess
import sys
from pathlib import Path

from emitted import ROOT, SPIKECTL

PAGE = ROOT / "docs/guides/microcontroller.md"


def follow(folder, edits=()):
    """Runs the commands of the page in a folder that looks like a checkout, and returns what they print."""
    commands = "\n".join(re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL))
    for old, new in edits:
        assert old in commands
        commands = commands.replace(old, new)
    for name in ("deploy", "examples"):
        (folder / name).symlink_to(ROOT / name)
    path = f"{Path(SPIKECTL).parent}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-e", "-c", commands], cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


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
    printed = follow(tmp_path, edits)
    assert float(re.search(r"mean return (-?[\d.]+)", printed)[1]) > -400
