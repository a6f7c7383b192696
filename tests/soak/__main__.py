"""Plays months of service in hours, and looks whether the server grows.

usage: python -m tests.soak [--seconds=N] [--round=N] [--rate=N] [--pause=SECONDS] [--json=FILE]

In each round agents stream, call, send batches and learn, sessions are recorded and explained, operators swap, promote,
replace and unload versions, tokens are replaced, pages are read, and clients are killed, all at the same time. After
each round the server becomes idle, and what it holds is a row of the table. Exits with status 1 if the memory that is allocated
grows by more than 1 MB a million decisions after the first million, beside the history of metrics, or descriptors or
threads grow. Failed requests are counted only: on a busy machine sessions of slow clients end. Needs the variables
SPIKESERVE_PROGRAM and SPIKELOAD_PROGRAM.
"""

import argparse
import dataclasses
import json
import pathlib
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

from tests.soak.activities import fill_memory_of_actions, soak  # noqa: E402
from tests.soak.server import MEGABYTE, SoakedServer  # noqa: E402

MILLION = 1_000_000
WARM_ROUNDS = 2  # in which each kind of work has taken its memory, also where a round has few decisions
MEMORY_PER_MILLION = 1 * MEGABYTE
# The history of metrics grows for 35 minutes and then no more. Rounds end at other points of its sweeps.
MEMORY_TOLERANCE = 8 * MEGABYTE
DESCRIPTORS_TOLERANCE = 4  # connections that close late
THREADS_TOLERANCE = 0


def parse_arguments():
    parser = argparse.ArgumentParser(prog="tests.soak")
    parser.add_argument("--seconds", type=float, default=4 * 3600, help="of all rounds together")
    parser.add_argument("--round", type=int, default=60, help="seconds of work in a round")
    parser.add_argument("--rate", type=float, default=0, help="requests a second of each load; 0: without a pause")
    parser.add_argument("--pause", type=float, default=0.05, help="seconds between two rounds of an activity")
    parser.add_argument("--json", type=pathlib.Path, help="file for the figures")
    return parser.parse_args()


def print_row(held, first, counts, failed):
    growth = (held.memory - first.memory) / MEGABYTE
    did = " ".join(f"{name}={count}" for name, count in sorted(counts.items()))
    print(
        f"{held.seconds:8.0f} {held.decisions / MILLION:9.2f} {held.memory / MEGABYTE:9.2f} {growth:+8.2f} "
        f"{held.resident / MEGABYTE:8.1f} "
        f"{held.descriptors:5} {held.threads:4} {failed:4}  {did}",
        flush=True,
    )


def baseline(rows):
    """Returns the first row after a million decisions and the warm rounds, or else the last warm one."""
    warm = rows[min(WARM_ROUNDS, len(rows)) - 1 :]
    return next((row for row in warm[:-1] if row.decisions >= MILLION), warm[0])


def complaints(rows):
    """Returns what has grown, as lines."""
    first, last = baseline(rows), rows[-1]
    decisions = (last.decisions - first.decisions) / MILLION
    allowed = MEMORY_TOLERANCE + decisions * MEMORY_PER_MILLION
    found = []
    # One late look may find memory that is about to be given back: the least of the last rows counts.
    memory = min(row.memory for row in rows[-3:]) - first.memory
    if memory > allowed:
        found.append(f"memory: expected at most {allowed / MEGABYTE:.1f} MB more, received {memory / MEGABYTE:.1f} MB")
    for name, tolerance in (("descriptors", DESCRIPTORS_TOLERANCE), ("threads", THREADS_TOLERANCE)):
        grown = min(getattr(row, name) for row in rows[-3:]) - getattr(first, name)
        if grown > tolerance:
            found.append(f"{name}: expected at most {tolerance} more, received {grown}")
    return found


def main():
    arguments = parse_arguments()
    end = time.monotonic() + arguments.seconds
    rows = []
    failed_of_all = 0
    print(" seconds  decisions        MB   growth resident   fds  thr  err  done")
    with tempfile.TemporaryDirectory() as folder, SoakedServer(folder) as server:
        fill_memory_of_actions(server)
        while len(rows) < WARM_ROUNDS + 1 or time.monotonic() < end:
            counts, failed = soak(server, arguments.round, arguments.rate, arguments.pause)
            rows.append(server.held())
            failed_of_all += failed
            print_row(rows[-1], baseline(rows), counts, failed)
    if arguments.json:
        arguments.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1))
    first, last = baseline(rows), rows[-1]
    millions = (last.decisions - first.decisions) / MILLION
    growth = (last.memory - first.memory) / MEGABYTE
    print(
        f"soak: {millions:.2f} million decisions after the first look, {growth:+.2f} MB, {failed_of_all} failed requests"
    )
    found = complaints(rows)
    for line in found:
        print(f"soak: {line}", file=sys.stderr)
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
