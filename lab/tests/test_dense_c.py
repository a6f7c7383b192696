"""The dense transformer in C, which policies on microcontrollers are compared with, decides as the engine, bit for bit."""

import os
import pathlib

import pytest
from emitted import C99, ROOT, SOURCES, Emitted, play, run

SANITIZED = ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
DENSE = pathlib.Path(__file__).parents[1] / "microcontrollers/dense.c"


# One layer, changes of the observation, and two layers.
@pytest.mark.parametrize("name", ["cartpole-small", "pendulum-delay", "lunar-lander"])
def test_equal_hashes(name, tmp_path):
    file = ROOT / f"deploy/policies/{name}/1/policy.safetensors"
    expected, *_ = run(os.environ["DENSE_BASELINE_PROGRAM"], file, 60, tmp_path).split()
    program = tmp_path / "dense"
    folders = [f"-I{tmp_path}", f"-I{SOURCES}"]
    run("gcc", *C99, *SANITIZED, *folders, DENSE, SOURCES / "port_host.c", "-o", program)
    assert play(Emitted(tmp_path, {}, tmp_path / "stream", expected), program) == expected.zfill(16)
