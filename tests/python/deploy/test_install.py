"""Installs components with `cmake --install`, and builds a program outside this tree against the C++ client."""

import os
import pathlib
import re
import shlex
import subprocess

import pytest
from serving import run, running_server

BUILD = pathlib.Path(os.environ["SPIKESERVE_BUILD_DIR"])
VERSION = os.environ["SPIKESERVE_VERSION"]
CONSUMER = pathlib.Path(__file__).parents[2] / "install" / "consumer"


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    """A folder into which only the client is installed."""
    folder = tmp_path_factory.mktemp("prefix")
    run("cmake", "--install", BUILD, "--prefix", folder, "--component", "client")
    return folder


def expect_an_action(program):
    with running_server() as addresses:
        assert run(program, addresses.grpc).stdout in ("action 0\n", "action 1\n")


def test_find_package(prefix, tmp_path):
    run("cmake", "-S", CONSUMER, "-B", tmp_path, "-G", "Ninja", f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", tmp_path)
    expect_an_action(tmp_path / "consumer")
    with running_server() as addresses:
        robot = subprocess.Popen([tmp_path / "robot", addresses.grpc], stdout=subprocess.PIPE, text=True)
        with robot:
            assert robot.stdout.readline() == "fresh\n"
            addresses.kill()
            assert robot.stdout.readline() == "local\n"


def test_pkg_config(prefix, tmp_path):
    [pc] = prefix.rglob("spikeserve.pc")
    environment = {**os.environ, "PKG_CONFIG_PATH": str(pc.parent)}
    assert run("pkg-config", "--modversion", "spikeserve", env=environment).stdout.strip() == VERSION
    flags = shlex.split(run("pkg-config", "--cflags", "--libs", "spikeserve", env=environment).stdout)
    program = tmp_path / "consumer"
    run("g++", "-std=c++20", CONSUMER / "main.cc", "-o", program, *flags)
    expect_an_action(program)


def test_public_headers_live_under_include_spikeserve(prefix):
    assert [entry.name for entry in (prefix / "include").iterdir()] == ["spikeserve"]


def test_an_older_minor_version_is_refused(prefix, tmp_path):
    lists = (CONSUMER / "CMakeLists.txt").read_text()
    lists, replaced = re.subn(r"(?<=find_package\(spikeserve )\d+\.\d+", "0.0", lists)
    assert replaced == 1
    (tmp_path / "CMakeLists.txt").write_text(lists)
    (tmp_path / "main.cc").write_text("int main() {}\n")
    refused = run("cmake", "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={prefix}", status=1)
    assert "spikeserve" in refused.stderr
