"""The long form of the attacks: prints a Markdown table of what each one did to the server and to a neighbour.

usage: PYTHONPATH=CLIENT build/venv/bin/python -m tests.attacks --program=build/release/bin/spikeserve [--seconds=10] [--rounds=3]
  [NAME...]

In each round there is a calm, then the attack hits another server of the machine, and then that of the neighbour. So the
middle one shows what the attacker takes of the processors, and other work of the machine is in all three. An attack is
within its bounds if the server stays below its budget of memory, and the p99 of the neighbour and of the health page below
twice what they were in the calm, or elsewhere. Exits with status 1 if an attack that has a budget of its own is not. The
servers log to build/attacks.txt.
"""

import argparse
import json
import math
import os
import pathlib
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / folder) for folder in ("python", "python/client", "interop"))]
os.environ["PYTHONPATH"] = ":".join([*sys.path[:4], os.environ.get("PYTHONPATH", "")])

from security import TOKENS, make_authority, make_certificate  # noqa: E402

from tests.attacks.catalogue import ATTACKS  # noqa: E402
from tests.attacks.observation import Rounds, observe  # noqa: E402
from tests.attacks.process import MEGABYTE  # noqa: E402

CALM_SECONDS = 2  # before each attack
MOST_RATIO = 2  # of the neighbour's p99
PERIODS = ("calm", "elsewhere", "during")
TRANSPORT = 150  # megabytes above idle of attacks without a budget of their own, as in test_attacks.py

COLUMNS = [
    "attack",
    "sent, MB",
    "connections",
    "memory above idle, MB: peak",
    "after",
    "processor, cores",
    "neighbour's p50, ms: calm, elsewhere, during",
    "p99, ms: calm, elsewhere, during",
    "ratio to calm, to elsewhere",
    "health page's p99, ms: calm, elsewhere, during",
    "ratio to calm, to elsewhere",
    "budget, MB",
    "within",
    "failed calls",
    "new client served after, s",
]


def periods(seen, page):
    """Returns the figures of the three periods, of the neighbour or of the health page."""
    figures = [getattr(seen, period) for period in PERIODS]
    return [each["health"] for each in figures] if page else figures


def milliseconds(seen, quantile, page=False):
    """Returns a latency in each period, or a dash where there were no answers."""
    values = [figures[quantile] for figures in periods(seen, page)]
    return ", ".join("-" if value is None else f"{1000 * value:.2f}" for value in values)


def ratios(seen, page=False):
    """Returns the p99 during the attack over the calm one and the one elsewhere; infinity if there were no answers."""
    *before, during = [figures["p99"] for figures in periods(seen, page)]
    return [during / each if each and during else math.inf for each in before]


def is_within(seen, budget):
    """Returns whether the server and the neighbour hardly noticed."""
    slowest = max(min(ratios(seen)), min(ratios(seen, page=True)))
    return seen.alive and seen.peak < budget * MEGABYTE and slowest < MOST_RATIO


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
        milliseconds(seen, "p50"),
        milliseconds(seen, "p99"),
        ", ".join(f"{ratio:.2f}" for ratio in ratios(seen)),
        milliseconds(seen, "p99", page=True),
        ", ".join(f"{ratio:.2f}" for ratio in ratios(seen, page=True)),
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
    parser.add_argument("--seconds", type=float, default=10, help="of each attack, in all rounds together [10]")
    parser.add_argument("--rounds", type=int, default=3, help="of each attack [3]")
    parser.add_argument("--frames", type=int, default=1_000_000, help="mutated frames [1000000]")
    parser.add_argument("names", nargs="*", metavar="NAME", help="attacks; all without one")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.program
    os.environ["SPIKECTL_PROGRAM"] = str(pathlib.Path(arguments.program).with_name("spikectl"))
    os.environ["SPIKESERVE_SERVER_FLAGS"] = arguments.flags
    outside = []
    print(f"| {' | '.join(COLUMNS)} |")
    print("| --- |" + " ---: |" * (len(COLUMNS) - 1), flush=True)
    with tempfile.TemporaryDirectory() as name, (ROOT / "build/attacks.txt").open("wb") as log:
        folder = pathlib.Path(name)
        make_authority(folder, "ca")
        make_certificate(folder, "server", "ca")
        (folder / "tokens.json").write_text(json.dumps(TOKENS))
        for attack in arguments.names or ATTACKS:
            count = arguments.frames if attack == "mutated_frames" else None
            number = 1 if count else arguments.rounds
            seconds = 600 if count else arguments.seconds / number
            rounds = Rounds(number, seconds, CALM_SECONDS, elsewhere=True)
            seen = observe(ATTACKS[attack], folder / "tokens.json", folder, rounds, 20 * MEGABYTE, count, log)
            budget = ATTACKS[attack].budget or TRANSPORT
            print(f"| {' | '.join(row(seen, budget))} |", flush=True)
            if ATTACKS[attack].budget is not None and not is_within(seen, budget):
                outside.append(attack)
    return 1 if outside else 0


if __name__ == "__main__":
    sys.exit(main())
