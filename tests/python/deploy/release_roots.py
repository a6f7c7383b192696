"""An empty Debian 12, for tests that install what a release publishes."""

import os
import pathlib
import shutil
import subprocess

ROOT = pathlib.Path(__file__).parents[3]
BUILD = pathlib.Path(os.environ["SPIKESERVE_BUILD_DIR"])


def run(*command, **options):
    """Runs a command to its end and returns what it printed."""
    finished = subprocess.run([*map(str, command)], capture_output=True, text=True, **options)
    assert finished.returncode == 0, f"{command}: {finished.stdout[-2000:]}{finished.stderr[-2000:]}"
    return finished.stdout


def bare_root():
    """Returns a root with Debian 12 and nothing else, which is made once for a build folder."""
    root = BUILD / "tests/bare-root"
    if not (root / "etc/debian_version").exists():
        new = root.with_suffix(".new")
        shutil.rmtree(new, ignore_errors=True)
        run("debootstrap", "--variant=minbase", "bookworm", new)
        new.rename(root)
    return root
