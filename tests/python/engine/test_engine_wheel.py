"""Wheels of every CPython that the engine supports are made from the checkout, and play as the build tree and a server.

The wheel of the engine needs no library of the build machine. The interpreter that runs the tests has the build tools and
the dependencies, so it needs no network; pip fetches those of the other interpreters.
"""

import json
import os
import pathlib
import platform
import re
import subprocess
import sys
import zipfile

import pytest
from own_environment import OFFLINE, OWN_VERSION
from serving import SHIPPED_POLICIES

CLIENT = pathlib.Path(__file__).parents[3] / "client/python"
PLAYER = pathlib.Path(__file__).with_name("wheel_player.py")
# Fails where it is not CPython, or cannot make virtual environments or compile extensions.
IS_COMPLETE = """
import ensurepip, pathlib, sys, sysconfig, venv
sys.exit(sys.implementation.name != "cpython" or not pathlib.Path(sysconfig.get_path("include"), "Python.h").is_file())
"""


def run(*command, env):
    return subprocess.run([*map(str, command)], check=True, stdout=subprocess.PIPE, text=True, env=env).stdout


def pyenv_interpreters(version):
    """Returns the interpreters of a version, such as 3.12, that pyenv has installed, the newest first."""
    root = pathlib.Path(os.environ.get("PYENV_ROOT", pathlib.Path.home() / ".pyenv"))
    releases = [path for path in root.glob(f"versions/{version}.*") if path.name.rpartition(".")[2].isdecimal()]
    releases.sort(key=lambda path: int(path.name.rpartition(".")[2]), reverse=True)
    return [release / f"bin/python{version}" for release in releases]


def find_interpreter(version):
    """Returns a complete CPython of a version, or None."""
    if version == OWN_VERSION:
        return sys.executable
    in_path = [pathlib.Path(folder, f"python{version}") for folder in os.environ["PATH"].split(os.pathsep)]
    for python in [*in_path, *pyenv_interpreters(version)]:
        # A shim of pyenv exists, but fails unless its version is active.
        if python.is_file() and not subprocess.run([python, "-c", IS_COMPLETE], capture_output=True).returncode:
            return python
    return None


@pytest.fixture(scope="module")
def expected(address):
    """The decisions of the build tree's engine."""
    played = json.loads(run(sys.executable, PLAYER, SHIPPED_POLICIES, address, env=os.environ))
    assert played["engine"] == played["server"]
    return played["engine"]


def check_engine_wheel(wheel, version):
    tag = f"cp{version.replace('.', '')}"
    release = os.environ["SPIKESERVE_VERSION"]
    assert re.match(rf"spikeserve_engine-{release}-{tag}-{tag}-manylinux_2_\d+_{platform.machine()}", wheel.name)
    names = zipfile.ZipFile(wheel).namelist()
    assert "spikeserve_engine/_engine.pyi" in names
    assert not [name for name in names if re.search(r"grpc|protobuf|torch", name)]


@pytest.mark.parametrize("version", ["3.10", "3.11", "3.12", "3.13"])
def test_wheels_are_enough_to_play(tmp_path, version, address, expected):
    python = find_interpreter(version)
    if python is None:
        pytest.skip(f"CPython {version}: expected one with headers and venv in PATH or pyenv, found none")
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    env = inherited | (OFFLINE if version == OWN_VERSION else {})
    run(python, "-m", "venv", tmp_path / "venv", env=env)
    python = tmp_path / "venv/bin/python"
    # With one name of the compiler, the sources that do not include Python are compiled once for all versions.
    build = {"SKBUILD_BUILD_DIR": f"{tmp_path}/build", "CMAKE_CXX_COMPILER_LAUNCHER": "ccache", "CXX": "g++"}
    run(CLIENT / "build_wheels.sh", tmp_path / "wheels", sys.executable, python, env=env | build)
    client_wheel, engine_wheel = sorted((tmp_path / "wheels").glob("*.whl"))
    check_engine_wheel(engine_wheel, version)
    run(python, "-m", "pip", "--quiet", "--disable-pip-version-check", "install", client_wheel, engine_wheel, env=env)
    pilot = "from spikeserve.piloting.robot_messages import require_robot; require_robot()"
    run(python, "-c", pilot, env=env)
    played = json.loads(run(python, PLAYER, SHIPPED_POLICIES, address, env=env))
    assert played["version"] == version
    assert all(pathlib.Path(module).is_relative_to(tmp_path / "venv") for module in played["modules"])
    assert played["engine"] == expected
    assert played["server"] == expected
