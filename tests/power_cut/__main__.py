"""Cuts the power of a machine whose server stores its sessions in a file, again and again.

usage: python -m tests.power_cut [--cuts=N] [--answers=N] [--seed=N]

The machine is user-mode Linux with a disk of its own. A cut kills its kernel, so what it had not written to the disk is
gone. After each cut the same disk is mounted by another machine: the store must be whole, no session may have fewer
decisions than were answered, and every answer, before and after, must be that of a server that was never interrupted.
Needs the variables SPIKESERVE_PROGRAM and SPIKECTL_PROGRAM, and Debian's packages user-mode-linux and e2fsprogs. Exits
with status 77 if the machine cannot be started.
"""

import argparse
import collections
import contextlib
import os
import pathlib
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

from serving import running_server
from stored_sessions import opening

from tests.power_cut.agents import SESSIONS, digest, end_episode_after, request

SKIPPED = 77
SILENCE_SECONDS = 300  # after which a machine that says nothing counts as broken
DISK_BYTES = 256 << 20


class Undisturbed:
    """Answers what each session answers without a cut, from a server without a store."""

    def __init__(self, service):
        self._service = service
        self._digests = collections.defaultdict(list)  # by session
        for i in range(SESSIONS):
            service.OpenSession(**opening(i) | {"durability": "NONE"})

    def digest(self, i, decision):
        """Returns the digest of a decision of session i."""
        digests = self._digests[i]
        while len(digests) <= decision:
            digests.append(digest(self._service.Act(**request(i, len(digests)))))
            end_episode_after(self._service, i, len(digests) - 1)
        return digests[decision]


class Machine:
    """User-mode Linux that plays tests/power_cut/agents.py on a disk."""

    def __init__(self, linux, disk, folder):
        programs = [f"{name}={os.environ[name]}" for name in ("SPIKESERVE_PROGRAM", "SPIKECTL_PROGRAM")]
        command = [
            *(linux, "mem=1G", "rootfstype=hostfs", "rootflags=/", "ro", "quiet", f"uml_dir={folder}"),
            *("con=null", "con0=null,fd:1", f"ubd0={disk}", f"init={pathlib.Path(__file__).parent / 'init.sh'}"),
            *(f"POWER_ROOT={ROOT}", f"POWER_PYTHON={sys.executable}", *programs),
        ]
        self._process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            errors="replace",
            start_new_session=True,
        )

    def lines(self):
        """Yields the lines that the machine prints. Ends when it has stopped, or after a long silence."""
        while True:
            silence = threading.Timer(SILENCE_SECONDS, self.cut)
            silence.start()
            line = self._process.stdout.readline()
            silence.cancel()
            if not line:
                return
            yield line.strip()

    def cut(self):
        """Kills all of the machine's processes at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def close(self):
        """Waits until the machine is gone."""
        self.cut()
        self._process.stdout.close()
        self._process.wait()


class Referee:
    """Reads what the machine says, and notes what is wrong."""

    def __init__(self, undisturbed):
        self._undisturbed = undisturbed
        self._answered = collections.Counter()  # decisions of each session that were acknowledged
        self.answers = 0
        self.errors = []

    def read(self, words):
        """Takes a line, without its first word."""
        kind, *rest = words
        if kind == "check":
            print("spikectl store check:", *rest[1:])
            if rest[0] != "0":
                self.errors.append(" ".join(words))
        elif kind == "has":
            i, decisions = map(int, rest)
            if decisions < self._answered[i]:
                self.errors.append(f"session {i}: expected {self._answered[i]} decisions, received {decisions}")
        elif kind == "answered":
            i, decision = map(int, rest[:2])
            self.answers += 1
            self._answered[i] = max(self._answered[i], decision + 1)
            if rest[2] != self._undisturbed.digest(i, decision):
                self.errors.append(f"session {i}, decision {decision}: another answer than without a cut")


def play_until_cut(machine, referee, answers):
    """Cuts the power after `answers` answers. Returns whether the machine has played at all."""
    began = False
    first = referee.answers
    for line in machine.lines():
        words = line.split()
        is_whole = len(words) > 1 and (words[1] != "answered" or len(words[-1]) == 16)
        if words[:1] != ["power:"] or not is_whole:
            print(line)
            continue
        began = True
        if words[1] == "ended":
            referee.errors.append(" ".join(words))
            break
        referee.read(words[1:])
        if referee.answers - first >= answers or referee.errors:
            machine.cut()
            break
    else:
        referee.errors.append(f"the machine stopped, or said nothing for {SILENCE_SECONDS} s")
    # What was still under way to this program was acknowledged, too.
    for line in machine.lines():
        words = line.split()
        if words[:2] == ["power:", "answered"] and len(words[-1]) == 16:
            referee.read(words[1:])
    return began


def main():
    parser = argparse.ArgumentParser(prog="tests.power_cut")
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--answers", type=int, default=2000, help="at most, between two cuts")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    linux, mkfs = shutil.which("linux.uml"), shutil.which("mkfs.ext4")
    if linux is None or mkfs is None:
        print("power: expected the programs linux.uml and mkfs.ext4, received", linux, mkfs)
        return SKIPPED
    chooses = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder, running_server() as server:
        disk = pathlib.Path(folder) / "disk"
        with disk.open("wb") as file:
            file.truncate(DISK_BYTES)
        subprocess.run([mkfs, "-q", disk], check=True)
        referee = Referee(Undisturbed(server.agent))
        for cut in range(arguments.cuts + 1):  # the last machine shows what the last cut has left
            machine = Machine(linux, disk, folder)
            try:
                began = play_until_cut(machine, referee, chooses.randint(1, arguments.answers))
            finally:
                machine.close()
            if not began and cut == 0:
                return SKIPPED
            print(f"{cut + 1} cuts, {referee.answers} answers", flush=True)
            if referee.errors:
                break
    print(*referee.errors, sep="\n")
    return 1 if referee.errors else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
