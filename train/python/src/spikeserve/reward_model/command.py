"""The command `python -m spikeserve reward_model`."""

from __future__ import annotations

import argparse
import importlib
import os
import pathlib
import sys
import time
from typing import Any

from spikeserve.printing import say


def add_command(subcommands: Any) -> None:
    """Adds the command and its flags to the parser of the package."""
    parser = subcommands.add_parser(
        "reward_model", help="judge recorded episodes: give them rewards after their ends"
    )
    parser.add_argument("recordings", help="the --record_dir of the server")
    parser.add_argument(
        "--model", required=True, metavar="MODULE:FUNCTION", help="judges one episode"
    )
    parser.add_argument("--server", help="addresses; default: SPIKESERVE_SERVER")
    parser.add_argument("--name", help="name of the verdicts; default: that of the model")
    parser.add_argument("--once", action="store_true", help="do not wait for more episodes")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> int:
    from spikeserve import Client, SpikeserveError
    from spikeserve.reward_model import follow

    sys.path.insert(0, os.getcwd())
    module, _, function = arguments.model.partition(":")
    try:
        model = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        say(f"--model: expected MODULE:FUNCTION, received {arguments.model}: {error}", error=True)
        return 2
    name = arguments.name or arguments.model
    seen: set[pathlib.Path] = set()
    with Client(arguments.server) as client:
        while True:
            try:
                for path, amended in follow(
                    pathlib.Path(arguments.recordings), model, client, name, seen
                ):
                    say(f"{path}: return {amended.episode_return:g}")
            except SpikeserveError as error:
                say(f"spikeserve reward_model: {error}", error=True)
                if arguments.once:
                    return 1
            if arguments.once:
                return 0
            time.sleep(1.0)
