"""Restarts three replicas in turn under streams of the C++ client, and prints how long sessions waited.

usage: build/venv/bin/python lab/bench/store_restarts.py [--streams=N] [--rate=N] [--seconds=N] [--durability=LEVEL]

`spikeload` plays one session on each stream. It measures, for each session, the longest time from when a request was
due to its decision. Needs the variables SPIKESERVE_PROGRAM and SPIKELOAD_PROGRAM. Exits with status 1 if an error reached
a session.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import urllib.request

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests" / "python")]

from replicated import running_fleet  # noqa: E402
from security import until  # noqa: E402


def sessions_of(replica):
    """Returns how many sessions the replica holds."""
    with urllib.request.urlopen(f"http://{replica.http_address}/metrics") as response:
        lines = response.read().decode().splitlines()
    return sum(float(line.split()[-1]) for line in lines if line.startswith("spikeserve_sessions{"))


def main():
    parser = argparse.ArgumentParser(prog="store_restarts.py")
    parser.add_argument("--streams", type=int, default=512)
    parser.add_argument("--rate", type=float, default=2.0, help="decisions a second of a session")
    parser.add_argument("--seconds", type=int, default=20, help="that the sessions play")
    parser.add_argument("--durability", default="async")
    arguments = parser.parse_args()
    with running_fleet("--durability=" + arguments.durability, http=True) as fleet:
        load = subprocess.Popen(
            [
                *(os.environ["SPIKELOAD_PROGRAM"], f"--server={fleet.addresses}", "--policy=cartpole", "--mode=stream"),
                *(f"--sessions={arguments.streams}", f"--streams={arguments.streams}"),
                "--retry",
                *(f"--rate={arguments.rate * arguments.streams}", f"--duration={arguments.seconds}s"),
            ]
        )
        until(lambda: sum(map(sessions_of, fleet.replicas)) == arguments.streams)
        for replica in fleet.replicas:
            replica.restart()
        assert load.poll() is None, "--seconds: the sessions ended before all replicas were restarted"
        return load.wait()


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
