"""The Python package has the version of the CMake project, also when built from its sdist."""

import os
import pathlib
import shutil
import subprocess
import sys

import pytest
import spikeserve

PACKAGE = pathlib.Path(__file__).parents[3] / "client/python"


def run(*arguments, **options):
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, **options).stdout


def test_the_version_is_the_projects():
    assert spikeserve.__version__ == os.environ["SPIKESERVE_VERSION"]


def install(target, source, compiler):
    pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-build-isolation", "--no-deps"]
    run(*pip, f"--target={target}", source, env=os.environ | {"CXX": compiler, "PYTHONPATH": ""})
    return os.environ | {"PYTHONPATH": str(target)}


def test_a_source_distribution_is_enough_to_install(tmp_path):
    run("-m", "hatchling", "build", "--target=sdist", f"--directory={tmp_path}", cwd=PACKAGE)
    (archive,) = tmp_path.glob("spikeserve-*.tar.gz")
    target = tmp_path / "installed"
    environment = install(target, archive, "c++")
    script = "import spikeserve, spikeserve._robot; print(spikeserve.__version__, spikeserve.__file__, spikeserve._robot.__file__)"
    version, *files = run("-c", script, env=environment).split()
    assert version == os.environ["SPIKESERVE_VERSION"]
    assert all(pathlib.Path(file).is_relative_to(target) for file in files)
    # The client alone, as a robot installs it, names what is missing.
    commands = [sys.executable, "-m", "spikeserve", "imitate"], [sys.executable, "-c", "import spikeserve; spikeserve.imitate"]
    for command in commands:
        refused = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert refused.returncode
        assert "expected the package spikeserve-train (pip install ./train/python in a checkout" in refused.stderr


@pytest.mark.parametrize("compiler", ["/nowhere/c++", "false"])
def test_without_a_compiler_only_the_pilot_is_left_out(tmp_path, compiler):
    """`false` stands for one that fails, such as one without the headers of Python."""
    environment = install(tmp_path / "installed", PACKAGE, compiler)
    script = (
        "import spikeserve\n"
        "options = spikeserve.PilotOptions(period=0.02)\n"
        "client = spikeserve.Client('127.0.0.1:1')\n"
        "try:\n"
        "    spikeserve.Pilot(client, 'pendulum', period=0.02)\n"
        "except ImportError as error:\n"
        "    print(spikeserve.__file__, error)\n"
    )
    file, _, message = run("-c", script, env=environment).partition(" ")
    assert pathlib.Path(file).is_relative_to(tmp_path)
    assert "Pilot: expected the compiled module spikeserve._robot, received none. Install the wheel" in message


def test_the_contract_compiles_where_no_protos_of_protobuf_are_installed(tmp_path):
    """protoc searches ../include of the running program, so this Python runs from another folder."""
    python = tmp_path / "bin/python"
    python.parent.mkdir()
    shutil.copy(pathlib.Path(sys.executable).resolve(), python)
    modules = os.pathsep.join([str(PACKAGE), *filter(None, sys.path)])
    script = "import hatch_build, sys; hatch_build.compile_proto(*sys.argv[1:])"
    compiled = tmp_path / "contract.binpb"
    subprocess.run(
        [python, "-c", script, PACKAGE.parents[1] / "proto", compiled],
        env={"PYTHONHOME": sys.base_prefix, "PYTHONPATH": modules},
        check=True,
    )
    assert b"google/protobuf/descriptor.proto" in compiled.read_bytes()
