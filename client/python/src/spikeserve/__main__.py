"""The commands of the package: `python -m spikeserve imitate`."""

from __future__ import annotations

import argparse
import sys

from spikeserve.imitation import command


def main() -> int:
    """Runs the command of sys.argv and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m spikeserve", description="Commands of spikeserve"
    )
    command.add_command(parser.add_subparsers(required=True, metavar="COMMAND"))
    arguments = parser.parse_args()
    status: int = arguments.run(arguments)
    return status


if __name__ == "__main__":
    sys.exit(main())
