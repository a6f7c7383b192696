"""Runs the clients that tests/interop/install.sh installs, and those of Debian."""

import os
import pathlib
import shutil
import subprocess

import pytest
from serving import DEADLINE_SECONDS

INSTALLED = pathlib.Path(os.environ["SPIKESERVE_INTEROP"])


def require(*names):
    """Returns the paths of programs. Skips the test if one is not installed, and fails it in CI."""
    paths = [
        shutil.which(name, path=f"{INSTALLED / 'bin'}:{os.environ['PATH']}:/usr/sbin")
        for name in names
    ]
    for name, path in zip(names, paths, strict=True):
        if path is None:
            missing(f"{name}: expected a program that `deploy/setup.sh` installs, found none")
    return paths[0] if len(paths) == 1 else paths


def missing(reason):
    """Skips the test, or fails it in CI."""
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def run(*command, timeout=DEADLINE_SECONDS, **options):
    """Runs a program and returns its subprocess.CompletedProcess, with its output as text."""
    return subprocess.run(
        [str(part) for part in command],
        check=False,
        capture_output=True,
        text=True,
        timeout=timeout,
        **options,
    )
