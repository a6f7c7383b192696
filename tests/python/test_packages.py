"""Installs the Debian packages of the server and the tools, starts the server as its unit does, calls it, and removes it.

The test works in an overlay of this machine's files in its own mount namespace, so it does not change the machine. It
needs root.
"""

import os
import pathlib
import re
import shutil
import subprocess
import textwrap

import pytest

BUILD = pathlib.Path(os.environ["SPIKESERVE_BUILD_DIR"])
VERSION = os.environ["SPIKESERVE_VERSION"]
DEADLINE_SECONDS = 500

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="installing packages needs root")

# Runs in the overlay. Prints lines that the test checks, and stops at the first command that fails.
INSIDE = textwrap.dedent(
    r"""
    set -euo pipefail
    dpkg --install /packages/spikeserve_*.deb /packages/spikeserve-tools_*.deb >/tmp/dpkg.log || cat /tmp/dpkg.log
    echo "user $(getent passwd spikeserve | cut -d: -f1,6)"
    unit=/usr/lib/systemd/system/spikeserve.service
    systemd-analyze verify "$unit" && echo "unit verified"
    # Does what systemd would do: creates the StateDirectory and runs the command line of the unit as its user.
    install -d -o spikeserve -g spikeserve /var/lib/spikeserve
    program=$(sed -n 's/^ExecStart=//p' "$unit")
    environment=$(sed -n 's/^Environment=//p' "$unit")
    mkfifo /tmp/announcements
    runuser -u spikeserve -- env ${environment//%S//var/lib} SPIKESERVE_LISTEN=127.0.0.1:0 \
      SPIKESERVE_HTTP_LISTEN=127.0.0.1:0 "$program" >/tmp/announcements &
    server=$!
    exec {announcements}</tmp/announcements
    read -r line <&"$announcements"
    spikectl policies --server="${line##* }" | grep -c cartpole
    zsh -fc 'autoload -U compinit && compinit -D && echo "zsh completes by $_comps[spikectl]"'
    fish -c 'complete --do-complete "spikectl explai"' | cut -f1
    kill -TERM "$(pgrep -u spikeserve -x spikeserve)"
    wait "$server" && echo "stopped cleanly"
    dpkg --purge spikeserve spikeserve-tools >/dev/null
    for left in /usr/bin/spikeserve /usr/bin/spikectl /usr/share/spikeserve "$unit" /var/lib/spikeserve; do
      [[ ! -e $left ]] || echo "left behind: $left"
    done
    getent passwd spikeserve || echo "user gone"
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
    exec chroot "$1/root" /bin/bash -c "$3"
    """
)


@pytest.fixture(scope="module")
def packages():
    """Returns the folder with the packages that cpack makes from the build."""
    shutil.rmtree(BUILD / "packages", ignore_errors=True)
    finished = subprocess.run(
        ["cpack", "-G", "DEB"], cwd=BUILD, capture_output=True, text=True, timeout=DEADLINE_SECONDS
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return BUILD / "packages"


def test_every_component_is_a_package_of_the_one_version(packages):
    names = {path.name.split("_")[0] for path in packages.glob(f"*_{VERSION}_*.deb")}
    assert {"spikeserve", "libspikeserve-dev", "spikeserve-tools"} <= names


def paths_in(packages, name):
    """Returns the paths in a package, without the leading slash."""
    [package] = packages.glob(f"{name}_*.deb")
    listed = subprocess.run(["dpkg-deb", "-c", package], capture_output=True, text=True, check=True)
    return re.findall(r" \./(\S*)", listed.stdout)


@pytest.mark.parametrize(("package", "program"), [("spikeserve", "spikeserve"), ("spikeserve-tools", "spikectl")])
def test_a_program_has_its_manual_page_and_completions(packages, package, program):
    assert {
        f"usr/share/man/man1/{program}.1.gz",
        f"usr/share/bash-completion/completions/{program}",
        f"usr/share/zsh/vendor-completions/_{program}",
        f"usr/share/fish/vendor_completions.d/{program}.fish",
    } <= set(paths_in(packages, package))


def test_the_package_holds_no_path_of_the_machine_that_built_it(packages):
    paths = paths_in(packages, "spikeserve")
    assert all(path.startswith("usr/") or path in ("", "usr/") for path in paths), paths


def test_the_server_installs_starts_answers_and_goes(packages, tmp_path):
    finished = subprocess.run(
        ["unshare", "--mount", "bash", "-c", OUTSIDE, "bash", tmp_path, packages, INSIDE],
        capture_output=True,
        text=True,
        timeout=DEADLINE_SECONDS,
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr
    lines = finished.stdout.splitlines()
    assert lines[0] == "user spikeserve:/var/lib/spikeserve"
    assert "unit verified" in lines
    assert int(lines[2]) >= 1, "a policy named cartpole is served"
    assert lines[3:] == ["zsh completes by _spikectl", "explain", "stopped cleanly", "user gone"], (
        finished.stdout + finished.stderr
    )
