"""The long form of the attacks: prints a Markdown table of what each one did to the server and to a neighbour.

usage: build/interop/venv/bin/python -m tests.attacks --program=build/release/bin/spikeserve [--seconds=10] [--rounds=1]
  [NAME...]

An attack is within its bounds if the server stays below its budget of memory, and the p99 of the neighbour and of the
health page below twice what they were before. With several rounds, the one with the median of the p99's ratio counts. Exits with status 1 if an attack that has
a budget of its own is not within its bounds; on a machine that does other work, the p99 says little.
"""

import argparse
import json
import math
import os
import pathlib
import statistics
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python"), str(ROOT / "tests" / "interop")]
os.environ["PYTHONPATH"] = ":".join(sys.path[:3])

from security import TOKENS, make_authority, make_certificate  # noqa: E402

from tests.attacks.catalogue import ATTACKS  # noqa: E402
from tests.attacks.observation import observe  # noqa: E402
from tests.attacks.process import MEGABYTE  # noqa: E402

CALM_SECONDS = 3  # before each attack
MOST_RATIO = 2  # of the neighbour's p99
TRANSPORT = 150  # megabytes above idle of attacks without a budget of their own, as in test_attacks.py

COLUMNS = [
    "attack",
    "sent, MB",
    "connections",
    "memory above idle, MB: peak",
    "after",
    "processor, cores",
    "neighbour's p50, ms: before, during",
    "p99, ms: before, during",
    "ratio",
    "health page's p99, ms: before, during",
    "ratio",
    "budget, MB",
    "within",
    "failed calls",
    "new client served after, s",
]


def milliseconds(figures, quantile):
    """Returns a latency of the neighbour, or a dash if it had no answers."""
    value = figures[quantile]
    return "-" if value is None else f"{1000 * value:.2f}"


def ratio(seen):
    """Returns the neighbour's p99 during the attack over that before; infinity if it was not served."""
    return ratio_of(seen.before, seen.during)


def ratio_of(before, during):
    """Returns the p99 during the attack over that before; infinity if there were no answers."""
    return during["p99"] / before["p99"] if before["p99"] and during["p99"] else math.inf


def health_ratio(seen):
    """As ratio(), of the health page."""
    return ratio_of(seen.before["health"], seen.during["health"])


def is_within(seen, budget):
    """Returns whether the server and the neighbour hardly noticed."""
    slowest = max(ratio(seen), health_ratio(seen))
    return seen.alive and seen.peak < budget * MEGABYTE and slowest < MOST_RATIO


def median_of(rounds):
    """Returns the observation whose ratio is the median."""
    middle = statistics.median_low(map(ratio, rounds))
    return next(seen for seen in rounds if ratio(seen) == middle)


def row(seen, budget):
    """Returns the cells of an observation."""
    served = "not within 5" if seen.served_after is None else f"{seen.served_after:.2f}"
    return [
        seen.attack,
        f"{seen.sent['bytes'] / 1e6:.1f}",
        str(seen.sent["connections"]),
        f"{seen.peak / MEGABYTE:.0f}" if seen.alive else "killed",
        f"{seen.after / MEGABYTE:.0f}" if seen.alive else "-",
        f"{seen.cores:.2f}",
        f"{milliseconds(seen.before, 'p50')}, {milliseconds(seen.during, 'p50')}",
        f"{milliseconds(seen.before, 'p99')}, {milliseconds(seen.during, 'p99')}",
        f"{ratio(seen):.2f}",
        f"{milliseconds(seen.before['health'], 'p99')}, {milliseconds(seen.during['health'], 'p99')}",
        f"{health_ratio(seen):.2f}",
        str(budget),
        "yes" if is_within(seen, budget) else "no",
        str(seen.during["failed"]),
        served if seen.alive else "-",
    ]


def main():
    """Runs the attacks, prints the table."""
    parser = argparse.ArgumentParser(prog="python3 -m tests.attacks", description=__doc__)
    parser.add_argument("--program", required=True, help="the server")
    parser.add_argument("--flags", default="", help="flags of the server")
    parser.add_argument("--seconds", type=float, default=10, help="of each attack [10]")
    parser.add_argument("--rounds", type=int, default=1, help="of each attack [1]")
    parser.add_argument("--frames", type=int, default=1_000_000, help="mutated frames [1000000]")
    parser.add_argument("names", nargs="*", metavar="NAME", help="attacks; all without one")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.program
    os.environ["SPIKESERVE_SERVER_FLAGS"] = arguments.flags
    outside = []
    print(f"| {' | '.join(COLUMNS)} |")
    print("| --- |" + " ---: |" * (len(COLUMNS) - 1), flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        make_authority(folder, "ca")
        make_certificate(folder, "server", "ca")
        (folder / "tokens.json").write_text(json.dumps(TOKENS))
        for attack in arguments.names or ATTACKS:
            count = arguments.frames if attack == "mutated_frames" else None
            seconds = 600 if count else arguments.seconds
            seen = median_of(
                [
                    observe(ATTACKS[attack], folder / "tokens.json", folder, seconds, CALM_SECONDS, 20 * MEGABYTE, count)
                    for _ in range(arguments.rounds)
                ]
            )
            budget = ATTACKS[attack].budget or TRANSPORT
            print(f"| {' | '.join(row(seen, budget))} |", flush=True)
            if ATTACKS[attack].budget is not None and not is_within(seen, budget):
                outside.append(attack)
    return 1 if outside else 0


if __name__ == "__main__":
    sys.exit(main())
