"""The command `python -m spikeserve convert`."""

from __future__ import annotations

import argparse
from typing import Any

from spikeserve.printing import say


def add_command(subcommands: Any) -> None:
    """Adds the command and its flags to the parser of the package."""
    parser = subcommands.add_parser(
        "convert",
        help="convert robots' data: LeRobotDataset v3, MCAP, Minari, recordings of a server",
    )
    formats = ("lerobot", "mcap", "minari", "spikeserve")
    parser.add_argument(
        "source",
        help="folder of a LeRobotDataset or a dataset of Minari, MCAP logs, or recordings",
    )
    parser.add_argument("out", help="folder to write; for spikeserve a .cbor file")
    parser.add_argument("--to", required=True, choices=formats, help="format of OUT")
    parser.add_argument(
        "--from", dest="source_format", choices=formats, help="format of SOURCE; default: detected"
    )
    text: Any
    for flag, kind, text in (
        ("--observation", _names, "columns or topics, separated by commas: /joints.position,/imu"),
        ("--action", str, "column, or topic of the actions, such as /command.data"),
        ("--reward", str, "column, or topic of the rewards"),
        ("--actions", int, "the action is an index below this number"),
        ("--action-low", _numbers, "lower bounds of the action, one or one for each element"),
        ("--action-high", _numbers, "upper bounds of the action"),
        ("--env", str, "name of the environment; of recordings: convert only its episodes"),
        ("--fps", float, "steps a second, where SOURCE does not say it"),
        ("--task", str, "what the robot does, a sentence for LeRobot"),
    ):
        parser.add_argument(flag, type=kind, metavar="VALUE", help=text)
    parser.add_argument("--overwrite", action="store_true", help="replace OUT, of the same format")
    parser.set_defaults(run=_run)


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, text.split(",")))


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(number) for number in text.split(","))


def _run(arguments: argparse.Namespace) -> int:
    try:
        from spikeserve.conversion.converting import convert
        from spikeserve.conversion.data import Selection

        selection = Selection(
            observation=arguments.observation or (),
            action=arguments.action or "",
            reward=arguments.reward or "",
            actions=arguments.actions,
            action_low=arguments.action_low or (),
            action_high=arguments.action_high or (),
            environment=arguments.env or "",
            fps=arguments.fps,
            task=arguments.task or "",
        )
        data = convert(
            arguments.source,
            arguments.out,
            arguments.to,
            source_format=arguments.source_format,
            selection=selection,
            overwrite=arguments.overwrite,
        )
    except (ValueError, OSError) as error:
        say(f"spikeserve convert: {error}", error=True)
        return 1
    for note in data.notes:
        say(f"note: {note}")
    say(
        f"{arguments.out}: {len(data.episodes)} episodes, {data.steps} steps of "
        f"{data.environment}; observation: {data.observation_size} numbers, "
        f"action: {_describe(data.action_space)}"
    )
    return 0


def _describe(space: Any) -> str:
    if hasattr(space, "n"):
        return f"Discrete({space.n})"
    return f"Box of {len(space.low)}"
