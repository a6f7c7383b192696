"""The long form of the attacks: prints a Markdown table of what each one did to the server and to a neighbour.

usage: build/interop/venv/bin/python -m tests.attacks --program=build/release/bin/spikeserve [--seconds=10] [NAME...]
"""

import argparse
import json
import os
import pathlib
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python"), str(ROOT / "tests" / "interop")]
os.environ["PYTHONPATH"] = ":".join(sys.path[:3])

from security import TOKENS, make_authority, make_certificate  # noqa: E402

from tests.attacks.catalogue import ATTACKS  # noqa: E402
from tests.attacks.observation import observe  # noqa: E402
from tests.attacks.process import MEGABYTE  # noqa: E402

COLUMNS = [
    "attack",
    "sent, MB",
    "connections",
    "memory above idle, MB: peak",
    "after",
    "processor, cores",
    "neighbour's p50, ms: before, during",
    "p99, ms: before, during",
    "failed calls",
    "new client served after, s",
]


def milliseconds(figures, quantile):
    """Returns a latency of the neighbour, or a dash if it had no answers."""
    value = figures[quantile]
    return "-" if value is None else f"{1000 * value:.2f}"


def row(seen):
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
        str(seen.during["failed"]),
        served if seen.alive else "-",
    ]


def main():
    """Runs the attacks, prints the table."""
    parser = argparse.ArgumentParser(prog="python3 -m tests.attacks", description=__doc__)
    parser.add_argument("--program", required=True, help="the server")
    parser.add_argument("--flags", default="", help="flags of the server")
    parser.add_argument("--seconds", type=float, default=10, help="of each attack [10]")
    parser.add_argument("--frames", type=int, default=1_000_000, help="mutated frames [1000000]")
    parser.add_argument("names", nargs="*", metavar="NAME", help="attacks; all without one")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = arguments.program
    os.environ["SPIKESERVE_SERVER_FLAGS"] = arguments.flags
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
            seen = observe(
                ATTACKS[attack], folder / "tokens.json", folder, seconds, 3, 20 * MEGABYTE, count
            )
            print(f"| {' | '.join(row(seen))} |", flush=True)


if __name__ == "__main__":
    main()
