"""Python environments of packages that conflict with those of the tests."""

import os
import pathlib
import subprocess
import sys
import sysconfig

import pytest
from serving import run

FOLDER = pathlib.Path(os.environ.get("OWN_ENVIRONMENTS", "/tmp/spikeserve-environments"))
DEADLINE_SECONDS = 3000
OWN_VERSION = "{}.{}".format(*sys.version_info)
# Makes pip use the packages of the tests instead of an index.
OFFLINE = {
    "PIP_NO_BUILD_ISOLATION": "0",  # 0 turns isolation off
    "PIP_NO_DEPS": "1",
    "PIP_NO_INDEX": "1",
    "PYTHONPATH": sysconfig.get_path("purelib"),
}


def python_with(*requirements):
    """Returns the Python of a virtual environment with `requirements`, made once. Skips the test if pip cannot."""
    name = "-".join("".join(c for c in r if c.isalnum() or c in "._") for r in requirements)
    folder = FOLDER / name
    python = folder / "bin/python"
    complete = folder / "complete"
    if complete.exists():
        return python
    subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
    install = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    installed = run(python, *install, *requirements, status=None)
    if installed.returncode != 0:
        reason = installed.stderr.strip().splitlines()[-1:] or ["no reason given"]
        pytest.skip(f"pip install {' '.join(requirements)}: {reason[0]}")
    complete.touch()
    return python


def run_in(python, script, *arguments):
    """Runs a script and returns what it printed."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}
    return run(python, "-c", script, *arguments, env=environment).stdout
