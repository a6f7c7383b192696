"""The commands of `python -m spikeserve`, which the package spikeserve-train has."""

from __future__ import annotations

import argparse
import importlib
import sys

from spikeserve import TRAIN

MODULES = ("spikeserve.imitation", "spikeserve.conversion", "spikeserve.reward_model")


def main() -> int:
    """Runs the command of sys.argv and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m spikeserve", description="Commands of spikeserve"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    try:
        for module in MODULES:
            importlib.import_module(f"{module}.command").add_command(commands)
    except ModuleNotFoundError as error:
        if error.name not in MODULES:
            raise
        print(f"spikeserve: expected the package {TRAIN}, received none", file=sys.stderr)
        return 2
    arguments = parser.parse_args()
    status: int = arguments.run(arguments)
    return status


if __name__ == "__main__":
    sys.exit(main())
