"""The commands of the package: `python -m spikeserve imitate` and `convert`."""

from __future__ import annotations

import argparse
import sys

from spikeserve.conversion import command as convert_command
from spikeserve.imitation import command as imitate_command


def main() -> int:
    """Runs the command of sys.argv and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m spikeserve", description="Commands of spikeserve"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    imitate_command.add_command(commands)
    convert_command.add_command(commands)
    arguments = parser.parse_args()
    status: int = arguments.run(arguments)
    return status


if __name__ == "__main__":
    sys.exit(main())
