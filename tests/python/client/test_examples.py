"""Runs the programs of examples/ and the blocks of README as they are printed. Those of Node.js and Go: tests/interop/examples."""

import os
import pathlib
import re
import subprocess
import sys

import pytest
from serving import DEADLINE_SECONDS

ROOT = pathlib.Path(__file__).parents[3]
EXAMPLES = ROOT / "examples"
PROGRAMS = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent
SERVER = "127.0.0.1:50051"


def run(*command, seconds=DEADLINE_SECONDS, **options):
    finished = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=seconds, check=False, **options)
    assert finished.returncode == 0, finished.stderr
    return finished.stdout


def readme_block(language):
    """Returns the only block of this language in README."""
    (block,) = re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    return block


def test_each_is_short_and_listed():
    listed = re.findall(r"^\| \[(\S+)\]\(\1\)", (EXAMPLES / "README.md").read_text(), re.MULTILINE)
    programs = {path.name for path in EXAMPLES.iterdir() if path.is_file() and path.suffix != ".md"}
    assert sorted(listed) == sorted(programs)
    for name in programs:
        assert 30 <= len((EXAMPLES / name).read_text().splitlines()) <= 60, name


def test_readme_is_a_page():
    assert len((ROOT / "README.md").read_text().split()) <= 600


def test_python(address):
    assert run(sys.executable, EXAMPLES / "call.py", address).startswith("return 500 in 500 steps\n")


def test_cpp(address):
    assert run(os.environ["EXAMPLE_CALL_PROGRAM"], address) == "return 500\n"


def test_a_robot_with_a_pilot(address):
    output = run(sys.executable, EXAMPLES / "robot.py", address)
    assert re.match(r"return -\d+ in 200 steps\n", output)
    sources = re.search(r"^(\d+) answers in time, (\d+) actions held, (\d+) of a local engine, (\d+) safe$", output, re.MULTILINE)
    assert sum(map(int, sources.groups())) == 200


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_from_an_own_environment_to_a_served_policy(tmp_path):
    pytest.importorskip("spikeserve_engine")
    environment = os.environ | {"PATH": f"{PROGRAMS}:{os.environ['PATH']}"}
    output = run(sys.executable, EXAMPLES / "own_environment.py", tmp_path / "cart", seconds=600, env=environment)
    expert, policy = map(float, re.search(r"^expert (\S+), policy (\S+)$", output, re.MULTILINE).groups())
    assert policy < 0 and expert < 0
    assert re.search(r"^cart/[12] plays Cart-v0: return ", output, re.MULTILINE)


def test_the_python_of_readme(address):
    block = readme_block("python")
    assert block.count(SERVER) == 1
    assert run(sys.executable, "-c", block.replace(SERVER, address)) == "500.0\n"


def test_the_cpp_of_readme(address):
    """tests/integration/CMakeLists.txt makes a program of the block."""
    assert SERVER in readme_block("cpp")
    assert re.fullmatch(r"action [01], \d+ spikes\n", run(os.environ["README_CALL_PROGRAM"], address))
