"""The command `python -m spikeserve imitate`."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from collections.abc import Callable
from typing import Any

from spikeserve.imitation.options import CHOSEN, GRADES, ImitationOptions
from spikeserve.printing import say


def add_command(subcommands: Any) -> None:
    """Adds the command and its flags to the parser of the package."""
    parser = subcommands.add_parser(
        "imitate",
        help="train a policy that imitates an expert in a Gymnasium environment",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("env_id", help="id of Gymnasium; `module:id` if a module registers it")
    parser.add_argument(
        "--expert",
        required=True,
        help="module:function, ALGORITHM:FILE.zip, SCRIPT:FILE.cleanrl_model, or a Minari dataset",
    )
    parser.add_argument(
        "--out",
        help="folder of the run, in which an interrupted run continues; default: the name of the "
        "policy, such as lunarlander for LunarLander-v3",
    )
    parser.add_argument(
        "--wrapper", action="append", default=[], help="module:class of a wrapper; may be repeated"
    )
    parser.add_argument(
        "--spiketrain", help="the program; default: $SPIKETRAIN, or the one on PATH"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="delete the run in --out and begin anew"
    )
    parser.add_argument(
        "--require",
        choices=GRADES,
        default=GRADES[0],
        help="exit with status 3 if the verdict is lower; the policy is written all the same",
    )
    for setting in dataclasses.fields(ImitationOptions):
        _add_setting(parser, setting)
    parser.set_defaults(run=_run)


def _pairs(text: str) -> tuple[tuple[float, float], ...]:
    pairs = []
    for item in filter(None, text.split(",")):
        hidden, _, readout = item.partition(":")
        pairs.append((float(hidden), float(readout)))
    return tuple(pairs)


def _words(text: str) -> tuple[str, ...]:
    return tuple(shlex.split(text))


# How the settings that are not plain numbers are written on the command line.
_PARSERS: dict[str, Callable[[str], Any]] = {
    "delay": str,
    "max_episode_steps": int,
    "lookback": int,
    "mirror": int,
    "patch_size": int,
    "silence": _pairs,
    "train_flags": _words,
}


def _add_setting(parser: argparse.ArgumentParser, setting: dataclasses.Field[Any]) -> None:
    shown: Any = setting.default
    if setting.name == "silence":
        shown = ",".join(f"{hidden:g}:{readout:g}" for hidden, readout in ImitationOptions.silence)
    elif setting.name == "train_flags":
        shown = shlex.join(ImitationOptions.train_flags)
    suffix = f" [{shown}]" if shown not in (None, ()) else ""
    if setting.name in CHOSEN:
        suffix = " [chosen]"
    parser.add_argument(
        "--" + setting.name.replace("_", "-"),
        type=_PARSERS.get(setting.name) or CHOSEN.get(setting.name) or type(setting.default),
        default=setting.default,
        metavar="VALUE",
        help=setting.metadata["help"].replace("%", "%%") + suffix,
    )


def _run(arguments: argparse.Namespace) -> int:
    from spikeserve.imitation.environments import EnvironmentFactory, load_object
    from spikeserve.imitation.pipeline import imitate

    settings = {
        field.name: getattr(arguments, field.name) for field in dataclasses.fields(ImitationOptions)
    }
    try:
        wrappers = [load_object(wrapper, "wrapper") for wrapper in arguments.wrapper]
        result = imitate(
            arguments.env_id,
            arguments.expert,
            arguments.out or EnvironmentFactory(arguments.env_id, wrappers).policy_name,
            options=ImitationOptions(**settings),
            wrappers=wrappers,
            spiketrain=arguments.spiketrain,
            overwrite=arguments.overwrite,
        )
    except KeyboardInterrupt:
        say("spikeserve imitate: interrupted; the same command continues", error=True)
        return 130
    except (ValueError, RuntimeError, OSError) as error:
        say(f"spikeserve imitate: {error}", error=True)
        return 1
    say(f"expert: {result.expert_figures}")
    for path, figures in (
        (result.policy, result.figures),
        (result.quantized, result.quantized_figures),
    ):
        if figures is None:
            continue
        spikes = f"{figures.spikes_per_decision:.0f} spikes a decision"
        say(f"{path}: return {figures}, {spikes}")
    if result.baselines:
        played = max(len(figures.returns) for figures in result.baselines.values())
        same_starts = {"the policy": result.figures.of_the_first(played)} | result.baselines
        say(f"on the first {played} of these starts, with the error on held-out episodes:")
        for name, figures in same_starts.items():
            say(f"{name}: return {figures}, error {result.errors[name]:.4f}")
    for warning in result.warnings:
        say(f"warning: {warning}")
    say(result.report)
    say(f"verdict: {result.verdict.grade}: {result.verdict.reason}")
    if result.verdict.grade != GRADES[-1]:
        for line in result.advice:
            say(f"try: {line}")
    return 0 if result.verdict.meets(arguments.require) else 3
