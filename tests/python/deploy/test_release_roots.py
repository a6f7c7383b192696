"""Each Debian package of a release installs in an empty Debian 12, and two runs make the same bytes.

Needs root, debootstrap and a mirror of Debian.
"""

import os
import pathlib
import shutil

import pytest
from serving import run

ROOT = pathlib.Path(__file__).parents[3]
BUILD = pathlib.Path(os.environ["SPIKESERVE_BUILD_DIR"])
PROGRAMS = {
    "spikeserve": "spikeserve --version",
    "spikeserve-tools": "spikectl --version && spikeload --version",
    "spikeserve-train": "spiketrain --version",
    "libspikeserve-dev": "test -e /usr/include/spikeserve/client.h",
    "libspikeserve-robot0": "ldconfig -p | grep -q libspikeserve_robot.so.0",
}

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="making a root needs root"),
    pytest.mark.skipif(shutil.which("debootstrap") is None, reason="without debootstrap"),
]


def bare_root():
    """Returns a root with Debian 12 and nothing else, which is made once for a build folder."""
    root = BUILD / "tests/bare-root"
    if not (root / "etc/debian_version").exists():
        new = root.with_suffix(".new")
        shutil.rmtree(new, ignore_errors=True)
        run("debootstrap", "--variant=minbase", "bookworm", new)
        new.rename(root)
    return root


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist") / "dist"
    run(ROOT / "deploy/release/make.sh", folder, BUILD, env=os.environ | {"PYTHONS": ""})
    return folder


@pytest.mark.parametrize("package", PROGRAMS)
def test_a_package_installs_in_an_empty_root(dist, package, tmp_path):
    found = list(dist.glob(f"{package}_*_amd64.deb"))
    if not found and package == "spikeserve-train":
        pytest.skip("the build has no training")
    root = tmp_path / "root"
    run("cp", "-a", bare_root(), root)
    shutil.copy(found[0], root / "tmp")
    shutil.copy("/etc/resolv.conf", root / "etc/resolv.conf")
    install = f"apt-get update -qq && apt-get install -y -qq --no-install-recommends /tmp/{found[0].name}"
    script = f"set -e; export DEBIAN_FRONTEND=noninteractive; ({install}) >/dev/null; {PROGRAMS[package]}"
    run("unshare", "--mount", "--pid", "--fork", "chroot", root, "sh", "-c", script)


def test_two_runs_make_the_same_bytes(dist, tmp_path):
    environment = os.environ | {"PYTHONS": "", "TZ": "Pacific/Auckland", "LC_ALL": "C"}
    run("sh", "-c", 'umask 077; "$@"', "sh", ROOT / "deploy/release/make.sh", tmp_path / "dist", BUILD, env=environment)
    assert (dist / "SHA256SUMS").read_text() == (tmp_path / "dist/SHA256SUMS").read_text()
