"""The commands `python -m spikeserve imitate` and `convert`, of the package spikeserve-train."""

from __future__ import annotations

import argparse
import importlib
import sys

from spikeserve import TRAIN


def main() -> int:
    """Runs the command of sys.argv and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m spikeserve", description="Commands of spikeserve"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    try:
        for module in ("spikeserve.imitation", "spikeserve.conversion"):
            importlib.import_module(f"{module}.command").add_command(commands)
    except ModuleNotFoundError as error:
        if error.name not in ("spikeserve.imitation", "spikeserve.conversion"):
            raise
        print(f"spikeserve: expected the package {TRAIN}, received none", file=sys.stderr)
        return 2
    arguments = parser.parse_args()
    status: int = arguments.run(arguments)
    return status


if __name__ == "__main__":
    sys.exit(main())
