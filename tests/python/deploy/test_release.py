"""`make dist` makes what a release publishes. Each file is checked by the tool of its kind, and the wheels play."""

import hashlib
import json
import os
import pathlib
import re
import sys
import tarfile
import textwrap

import pytest
from own_environment import OFFLINE, OWN_VERSION
from serving import SHIPPED_POLICIES, run

# Runs in the overlay. Prints lines that the test checks, and stops at the first command that fails.
INSIDE = textwrap.dedent(
    r"""
    set -euo pipefail
    dpkg --install /packages/spikeserve_*.deb /packages/spikeserve-tools_*.deb >/tmp/dpkg.log || cat /tmp/dpkg.log
    echo "user $(getent passwd spikeserve | cut -d: -f1,6)"
    unit=/usr/lib/systemd/system/spikeserve.service
    systemd-analyze verify "$unit" && echo "unit verified"
    # Does what systemd would do: creates the StateDirectory and runs the command line of the unit as its user.
    install -d -o spikeserve -g spikeserve -m 700 /var/lib/spikeserve
    program=$(sed -n 's/^ExecStart=//p' "$unit")
    start() {
      rm -f /tmp/announcements
      mkfifo /tmp/announcements
      environment=$(sed -n 's/^Environment=//p' "$unit")
      runuser -u spikeserve -- env ${environment//%S//var/lib} SPIKESERVE_LISTEN=127.0.0.1:0 \
        SPIKESERVE_HTTP_LISTEN=127.0.0.1:0 SPIKESERVE_REFLECTION_V1ALPHA=true "$program" >/tmp/announcements &
      server=$!
      exec {announcements}</tmp/announcements
      read -r line <&"$announcements"
      address=${line##* }
    }
    stop() {
      kill -TERM "$(pgrep -u spikeserve -x spikeserve)"
      wait "$server"
    }
    trap 'stop || true' EXIT
    start
    spikectl policies --server="$address" | grep -c cartpole
    "$1" -c "$2" "$address" play
    # An upgrade installs the files of the new version over those of the old one, and starts the server again.
    stop
    dpkg --install /packages/spikeserve_*.deb >/tmp/dpkg.log || cat /tmp/dpkg.log
    start
    "$1" -c "$2" "$address" look
    zsh -fc 'autoload -U compinit && compinit -D && echo "zsh completes by $_comps[spikectl]"'
    fish -c 'complete --do-complete "spikectl explai"' | cut -f1
    stop && echo "stopped cleanly"
    trap - EXIT
    dpkg --purge spikeserve spikeserve-tools >/dev/null
    for left in /usr/bin/spikeserve /usr/bin/spikectl /usr/share/spikeserve "$unit" /var/lib/spikeserve; do
      [[ ! -e $left ]] || echo "left behind: $left"
    done
    getent passwd spikeserve || echo "user gone"
    """
)

# Plays in a session, or shows how many decisions it has: python -c ROBOT ADDRESS play|look.
ROBOT = textwrap.dedent(
    """
    import sys
    import grpc
    from serving import Service

    with grpc.insecure_channel(sys.argv[1]) as channel:
        service = Service(channel, "spikeserve.v1.PolicyService")
        session = "0123456789abcdef" * 2
        if sys.argv[2] == "play":
            service.OpenSession(session_id=session, policy="cartpole")
            for step in range(3):
                service.Act(session_id=session, step=step, observation=[0.0] * 4, reward=1.0)
        print("decisions", service.GetSession(session_id=session).decisions)
    """
)

OUTSIDE = textwrap.dedent(
    r"""
    set -euo pipefail
    mkdir "$1"/{upper,work,root}
    mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
    mount --rbind /dev "$1/root/dev"
    mount --rbind /proc "$1/root/proc"
    mkdir "$1/root/packages"
    mount --bind "$2" "$1/root/packages"
    exec env PYTHONPATH="$6" chroot "$1/root" /bin/bash -c "$3" bash "$4" "$5"
    """
)


def use_in_overlay(packages, folder):
    """Runs INSIDE with the packages of a folder. Returns the finished process. `folder` is an empty one."""
    return run(
        *("unshare", "--mount", "bash", "-c", OUTSIDE, "bash", folder, packages, INSIDE),
        *(sys.executable, ROBOT, pathlib.Path(__file__).parents[1])
    )


ROOT = pathlib.Path(__file__).parents[3]
BUILD = pathlib.Path(os.environ["SPIKESERVE_BUILD_DIR"])
VERSION = os.environ["SPIKESERVE_VERSION"]
TOOLS = ROOT / "build/release-tools/venv/bin"


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    """Returns the folder that deploy/release/make.sh fills, with wheels for this interpreter alone."""
    folder = tmp_path_factory.mktemp("dist") / "dist"
    binaries = str(pathlib.Path(sys.executable).parent)
    environment = os.environ | OFFLINE | {"PYTHONS": OWN_VERSION, "PATH": f"{binaries}:{os.environ['PATH']}"}
    print(run(ROOT / "deploy/release/make.sh", folder, BUILD, env=environment).stdout)
    return folder


def names(folder, pattern):
    return sorted(path.name for path in folder.glob(pattern))


def test_a_release_has_everything(dist):
    packages = [name.split("_")[0] for name in names(dist, "*.deb")]
    robot = {"libspikeserve-robot0", "libspikeserve-robot-dev"}
    assert {"spikeserve", "spikeserve-tools", "libspikeserve-dev"} | robot <= set(packages)
    assert names(dist, "spikeserve-robot-*") == [f"spikeserve-robot-{VERSION}.crate", f"spikeserve-robot-go-{VERSION}.tgz"]
    tag = f"cp{OWN_VERSION.replace('.', '')}"
    [client, engine, train] = names(dist, "*.whl")
    for name, wheel in (("spikeserve", client), ("spikeserve_engine", engine)):
        assert re.match(rf"{name}-{VERSION}-{tag}-{tag}-manylinux", wheel)
    assert train == f"spikeserve_train-{VERSION}-py3-none-any.whl"
    assert names(dist, "*.tar.gz") == [
        f"spikeserve-{VERSION}.src.tar.gz",
        f"spikeserve-{VERSION}.tar.gz",
        f"spikeserve_engine-{VERSION}.tar.gz",
        f"spikeserve_train-{VERSION}.tar.gz",
    ]


def test_the_checksums_are_those_of_the_files(dist):
    listed = dict(reversed(line.split("  ")) for line in (dist / "SHA256SUMS").read_text().splitlines())
    assert set(listed) == {path.name for path in dist.iterdir()} - {"SHA256SUMS"}
    for name, digest in listed.items():
        assert hashlib.sha256((dist / name).read_bytes()).hexdigest() == digest


def test_the_sbom_is_valid_and_names_every_file(dist):
    sbom = dist / f"spikeserve-{VERSION}.spdx.json"
    run(TOOLS / "pyspdxtools", "--infile", sbom)
    packages = {package["name"]: package for package in json.loads(sbom.read_text())["packages"]}
    published = {path.name for path in dist.iterdir()} - {"SHA256SUMS", sbom.name}
    assert published <= set(packages)
    assert {"libprotobuf32", "libgrpc++-dev", "liblmdb0", "uPlot", "grpcio"} <= set(packages)


def test_twine_is_content(dist):
    run(TOOLS / "twine", "check", "--strict", *dist.glob("*.whl"), *dist.glob("spikeserve*[0-9].tar.gz"), env=os.environ | {"PYTHONPATH": ""})


def test_lintian_is_content(dist):
    run("lintian", "--fail-on", "error", *dist.glob("*.deb"))


def paths_in(dist, name):
    """Returns the paths in a Debian package, without the leading slash."""
    [package] = dist.glob(f"{name}_*.deb")
    return re.findall(r" \./(\S*)", run("dpkg-deb", "-c", package).stdout)


@pytest.mark.parametrize(("package", "program"), [("spikeserve", "spikeserve"), ("spikeserve-tools", "spikectl")])
def test_a_program_has_its_manual_page_and_completions(dist, package, program):
    assert {
        f"usr/share/man/man1/{program}.1.gz",
        f"usr/share/bash-completion/completions/{program}",
        f"usr/share/zsh/vendor-completions/_{program}",
        f"usr/share/fish/vendor_completions.d/{program}.fish",
    } <= set(paths_in(dist, package))


def test_the_package_holds_no_path_of_the_machine_that_built_it(dist):
    paths = paths_in(dist, "spikeserve")
    assert all(path.startswith("usr/") or path in ("", "usr/") for path in paths), paths


@pytest.mark.skipif(os.geteuid() != 0, reason="installing packages needs root")
def test_the_server_installs_starts_answers_and_goes(dist, tmp_path):
    finished = use_in_overlay(dist, tmp_path)
    lines = finished.stdout.splitlines()
    assert lines[0] == "user spikeserve:/var/lib/spikeserve"
    assert "unit verified" in lines
    assert int(lines[2]) >= 1, "a policy named cartpole is served"
    assert lines[3:5] == ["decisions 3"] * 2, "the session of before the upgrade goes on"
    assert lines[5:] == ["zsh completes by _spikectl", "explain", "stopped cleanly", "user gone"], (
        finished.stdout + finished.stderr
    )


def test_the_notes_are_those_of_the_changelog(dist):
    notes = (dist / "RELEASE_NOTES.md").read_text()
    assert notes.startswith("# spikeserve ")
    assert notes.split("\n", 2)[2].strip() in (ROOT / "CHANGELOG.md").read_text()


def test_the_source_archive_is_the_commit(dist):
    with tarfile.open(dist / f"spikeserve-{VERSION}.src.tar.gz") as archive:
        held = {name.removeprefix(f"spikeserve-{VERSION}/") for name in archive.getnames()}
    assert set(run("git", "-C", ROOT, "ls-tree", "-r", "--name-only", "HEAD").stdout.splitlines()) <= held


@pytest.mark.parametrize("kind", ["*.whl", "spikeserve*[0-9].tar.gz"], ids=["wheels", "sdists"])
def test_the_python_packages_install_in_an_empty_environment(dist, kind, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv/bin/python"
    # The sources of the sdist are those of the wheel, so the compiler cache has what the wheel was made of.
    cache = {"CMAKE_CXX_COMPILER_LAUNCHER": "ccache", "CCACHE_BASEDIR": str(tmp_path), "CCACHE_NOHASHDIR": "1"}
    environment = os.environ | OFFLINE | cache | {"CXX": "g++", "TMPDIR": str(tmp_path)}
    run(python, "-m", "pip", "--quiet", "install", *dist.glob(kind), env=environment)
    policy = SHIPPED_POLICIES / "cartpole-small/1/policy.safetensors"
    script = (
        "import spikeserve, spikeserve.engine, spikeserve_engine\n"
        "assert spikeserve.imitate\n"
        "spikeserve.piloting.robot_messages.require_robot()\n"
        f"session = spikeserve.engine.Engine({str(policy)!r}).session()\n"
        "print(session.act([0.01, 0.0, 0.02, 0.0]).action, spikeserve_engine.__file__)"
    )
    action, file = run(python, "-c", script, env=environment).stdout.split()
    assert action in "01"
    assert pathlib.Path(file).is_relative_to(tmp_path)


def test_no_hint_names_a_package_that_nobody_published():
    """Anybody may register the name of an unpublished package, so no text may tell people to install it by its name."""
    by_name = re.compile(r"pip install [^\n]*(?<![\w/.-])spikeserve(-engine|-train)?(\[[\w,]*\])?(?![\w/.-])")
    for path in run("git", "-C", ROOT, "ls-files").stdout.splitlines():
        file = ROOT / path
        if file.suffix in {".md", ".py", ".sh", ".toml", ".txt", ".cc"} and file.is_file() and file.name != "test_release.py":
            assert not by_name.search(file.read_text()), path
    for package in ("client", "train"):
        assert '"spikeserve-engine' not in (ROOT / package / "python/pyproject.toml").read_text()
