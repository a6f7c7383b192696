"""Installs the Debian packages of the server and the tools, starts the server as its unit does, plays, upgrades and removes it.

All of it happens in an overlay of this machine's files in a mount namespace of its own, so it does not change the machine. It
needs root.
"""

import pathlib
import sys
import textwrap

from serving import run

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
