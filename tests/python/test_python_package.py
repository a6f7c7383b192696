"""The Python package has the version of the CMake project, also when built from its sdist."""

import os
import pathlib
import subprocess
import sys

import spikeserve

PACKAGE = pathlib.Path(__file__).parents[2] / "client/python"


def run(*arguments, **options):
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, **options).stdout


def test_the_version_is_the_projects():
    assert spikeserve.__version__ == os.environ["SPIKESERVE_VERSION"]


def test_a_source_distribution_is_enough_to_install(tmp_path):
    run("-m", "hatchling", "build", "--target=sdist", f"--directory={tmp_path}", cwd=PACKAGE)
    (archive,) = tmp_path.glob("spikeserve-*.tar.gz")
    target = tmp_path / "installed"
    pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-build-isolation"]
    run(*pip, "--no-deps", f"--target={target}", archive)
    script = "import spikeserve; print(spikeserve.__version__, spikeserve.__file__)"
    version, file = run("-c", script, env=os.environ | {"PYTHONPATH": str(target)}).split()
    assert version == os.environ["SPIKESERVE_VERSION"]
    assert pathlib.Path(file).is_relative_to(target)
