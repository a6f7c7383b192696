"""The release before continues with the files of today's server. Builds it from its commit, which takes minutes."""

import os
import pathlib
import re
import shutil
import subprocess

import pytest
from redis_servers import WITHOUT_REDIS
from release_files import RELEASES, assert_contains, convert_int8, play_first_half, play_second_half, server_on

ROOT = pathlib.Path(__file__).parents[3]
KINDS = ["file", pytest.param("redis", marks=WITHOUT_REDIS)]
BEFORE = max(path for path in RELEASES.iterdir() if path.is_dir())


def build_release(release):
    """Returns the program of a release, built from its commit. Skips if the checkout does not have it."""
    table = (RELEASES / "README.md").read_text()
    commit = re.search(rf"^\| {re.escape(release.name)} \| commit (\w+),", table, re.MULTILINE)[1]
    tree = ROOT / "build/releases" / release.name
    program = tree / "build/release/bin/spikeserve"
    if not program.exists():
        shutil.rmtree(tree, ignore_errors=True)
        tree.mkdir(parents=True)
        archive = subprocess.run(["git", "-C", ROOT, "archive", commit], capture_output=True)
        if archive.returncode != 0:
            pytest.skip(f"git: expected commit {commit}, received {archive.stderr.decode().strip()}")
        subprocess.run(["tar", "-x", "-C", tree], input=archive.stdout, check=True)
        parts = [f"-DSPIKESERVE_BUILD_{part}=OFF" for part in ("TESTS", "TRAIN", "PYTHON")]
        environment = os.environ | {"CCACHE_BASEDIR": str(tree), "CCACHE_NOHASHDIR": "1"}
        configure = ["cmake", "--preset", "release", *parts]
        for command in (configure, ["cmake", "--build", "build/release", "--target", "spikeserve"]):
            subprocess.run(command, cwd=tree, check=True, stdout=subprocess.DEVNULL, env=environment)
    return program


@pytest.mark.parametrize("kind", KINDS)
def test_the_release_before_goes_on_with_the_files_of_today(kind, tmp_path, monkeypatch):
    """Opens sessions today, and compares how both programs continue with them."""
    program = build_release(BEFORE)
    state = tmp_path / "left" / kind
    state.mkdir(parents=True)
    shutil.copytree(BEFORE / "policies", state.parent / "policies")
    convert_int8(state.parent / "policies")  # which only the release before serves
    with server_on(state) as services:
        play_first_half(*services)
    twin = shutil.copytree(state.parent, tmp_path / "twin") / kind
    with server_on(state) as services:
        answers = play_second_half(*services)
    monkeypatch.setenv("SPIKESERVE_PROGRAM", str(program))
    with server_on(twin) as services:
        assert_contains(answers, play_second_half(*services))
