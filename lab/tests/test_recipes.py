"""The recipes are those of the shipped policies."""

import argparse
import dataclasses
import json
import os
import re
import shlex
import subprocess
import sys

import pytest
from policy_file import read_policy
from serving import DEPLOY, SHIPPED_POLICIES
from spikeserve.imitation.command import add_command
from spikeserve.imitation.options import ImitationOptions

ROOT = DEPLOY.parent
NAMES = sorted(path.name for path in SHIPPED_POLICIES.iterdir())
RECIPES = {"cartpole-small": "cartpole-frugal"}  # by policies with another name


def training(path):
    _, metadata = read_policy(path)
    return json.loads(metadata["training"])


def stages(name):
    """Returns the records of the stages of a policy's first version, the first stage first."""
    record = training(SHIPPED_POLICIES / name / "1/policy.safetensors")
    return [*record.pop("lineage"), record]


def imitation(recipe):
    """Returns the settings of the command `spikeserve imitate` of a recipe, as policies record them."""
    parser = argparse.ArgumentParser()
    add_command(parser.add_subparsers())
    command = re.search(r"^imitate .*$", recipe.replace("\\\n", " "), re.MULTILINE)
    words = shlex.split(command[0])
    common = re.search(r"^settings=\((.*?)\)$", (ROOT / "lab/recipes/imitation.sh").read_text(), re.MULTILINE | re.DOTALL)
    flags = [*common[1].split(), *words[2:]]
    arguments = parser.parse_args([*words[:2], *flags, "--out=."])
    settings = {field.name: getattr(arguments, field.name) for field in dataclasses.fields(ImitationOptions)}
    names = [name.rpartition(":")[2] for name in (arguments.env_id, *arguments.wrapper)]
    return json.loads(json.dumps({"environment": "-".join(names)} | settings))


def with_settings_for_flags(recorded):
    """Returns the settings of a policy. Flags of spiketrain that have become settings since then are settings."""
    flags = dict(flag.removeprefix("--").split("=") for flag in recorded["train_flags"])
    own = {name: int(flags.pop(name)) for name in list(flags) if name == "context"}
    return recorded | own | {"train_flags": [f"--{name}={value}" for name, value in flags.items()]}


@pytest.mark.parametrize("name", NAMES)
def test_there_is_a_recipe_with_as_many_stages(name):
    recipe = (ROOT / "lab/recipes" / f"{RECIPES.get(name, name)}.sh").read_text()
    imitated = [stage["imitation"] for stage in stages(name) if "imitation" in stage]
    if imitated:
        recorded, of_recipe = with_settings_for_flags(imitated[-1]), imitation(recipe)
        # Settings that are younger than the policy are in the recipe only.
        assert recorded == {name: of_recipe[name] for name in recorded}
        return
    trained = [stage for stage in stages(name) if stage["command"].split()[1] == "train"]
    # A stage whose policy was replaced by a later one is in the recipe and not in the lineage.
    assert len(re.findall(r"^stage ", recipe, re.MULTILINE)) >= len(trained)


def wrapper(path, program, small):
    """Writes a program that calls another with further flags by subcommand, of which the last ones count."""
    cases = "".join(f"*' {command} '*) set -- \"$@\" {flags} ;;\n" for command, flags in small.items())
    path.write_text(f'#!/bin/bash\ncase " $* " in\n{cases}esac\nexec {program} "$@"\n')
    path.chmod(0o755)
    return path


def test_a_recipe_trains_in_miniature_and_continues(tmp_path):
    small = {"dataset": "--steps=200", "train": "--iterations=2 --batch=2 --episodes=1", "eval": "--episodes=2"}
    small["quantize"] = "--episodes=2 --allow_loss"
    spiketrain = wrapper(tmp_path / "spiketrain", os.environ["SPIKETRAIN"], small)
    command = [ROOT / "lab/recipes/cartpole-sparse.sh", spiketrain, tmp_path / "out"]
    subprocess.run(command, check=True, capture_output=True)
    policy = tmp_path / "out/3-quieter/policy.safetensors"
    assert [len(training(policy)["lineage"]), training(policy)["seed"]] == [2, 3]
    assert (tmp_path / "out/integer/policy.safetensors").is_file()
    policy.unlink()  # interrupted before the last stage
    kept = [path for path in (tmp_path / "out").glob("*/policy.safetensors") if path.parent.name != "integer"]
    before = [path.stat().st_mtime_ns for path in kept]
    (tmp_path / "out/integer/policy.safetensors").unlink()
    subprocess.run(command, check=True, capture_output=True)
    assert policy.is_file()
    assert [path.stat().st_mtime_ns for path in kept] == before


def test_a_recipe_imitates_in_miniature(tmp_path):
    small = "--steps=600 --iterations=3 --batch=2 --clip-steps=4 --silence= --selection-episodes=2 --episodes=2 --environments=2"
    python = wrapper(tmp_path / "python", sys.executable, {"imitate": small})
    environment = {**os.environ, "PYTHON": str(python)}
    command = [ROOT / "lab/recipes/repeat-first.sh", os.environ["SPIKETRAIN"], tmp_path / "out"]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    assert list((tmp_path / "out/policies").glob("*/*/policy.safetensors"))
