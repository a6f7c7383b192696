"""Follows how every shipped policy came to be, from its file to its first stage."""

import argparse
import dataclasses
import hashlib
import json
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
FILES = sorted(SHIPPED_POLICIES.glob("*/*/policy.safetensors"))
ROUNDED = [path for path in FILES if path.parts[-2] != "1"]
NAMES = sorted(path.name for path in SHIPPED_POLICIES.iterdir())
SHA256 = re.compile(r"[0-9a-f]{64}")


def training(path):
    _, metadata = read_policy(path)
    return json.loads(metadata["training"])


def stages(path):
    """Returns the records of a policy's stages, the first stage first."""
    record = training(path)
    return [*record.pop("lineage", []), record]


def flag(record, name):
    found = re.search(rf"--{name}=(\S+)", record["command"])
    return found and found.group(1)


def parts(record):
    """Returns the recipes of the datasets of a training."""
    return record["data"].get("parts", [record["data"]])


def identities(record):
    """Returns whether each identity that the command of a record has to name is recorded."""
    named = {"commit": "commit" in record}
    if flag(record, "init") or flag(record, "policy"):
        named["parent_sha256"] = bool(SHA256.fullmatch(record.get("parent_sha256", "")))
    if flag(record, "data"):
        recorded = record.get("data_sha256", {})
        named["data_sha256"] = list(recorded) == flag(record, "data").split(",")
    if "data" in record and any("student_steps" in part for part in parts(record)):
        named["student_sha256"] = all("student_sha256" in part for part in parts(record) if "student_steps" in part)
    return named


@pytest.mark.parametrize("path", FILES, ids=lambda path: "/".join(path.parts[-3:-1]))
def test_every_stage_says_what_it_was_made_from(path):
    earlier = None
    for record in stages(path):
        program, command = record["command"].split()[:2]
        assert program == "spiketrain"
        assert command in ("train", "quantize")
        missing = {name for name, recorded in identities(record).items() if not recorded}
        assert missing == set(record.get("not_recorded", [])), record["command"]
        start = flag(record, "init")
        assert (start is None) == (earlier is None or command == "quantize"), "only the first stage starts from nothing"
        # Version 1 is a stage's policy with its evaluation. The test below knows its hash.
        is_first = start and re.fullmatch(r"policies/[^/]+/1/policy\.safetensors", start)
        if start and not is_first and start != f"{flag(earlier, 'out')}/policy.safetensors":
            assert record["parent_note"], "a parent of another name needs an explanation"
        earlier = record


@pytest.mark.parametrize("path", ROUNDED, ids=lambda path: "/".join(path.parts[-3:-1]))
def test_the_rounded_versions_follow_from_the_float32_version(path):
    first = SHIPPED_POLICIES / path.parts[-3] / "1/policy.safetensors"
    record = training(path)
    made_for_integers = {"quantize": "--to=integer", "train": "--arithmetic=integer"}[record["command"].split()[1]]
    assert (made_for_integers in record["command"]) == (path.parts[-2] == "3")
    assert record["parent_sha256"] == hashlib.sha256(first.read_bytes()).hexdigest()
    assert record["lineage"] == stages(first)


def test_the_page_shows_what_the_integer_versions_return():
    script = ROOT / "train/recipes/integer_table.py"
    table = subprocess.run([sys.executable, script], check=True, stdout=subprocess.PIPE, text=True).stdout
    assert table.count("\n") == 2 + len(NAMES)
    assert table in (ROOT / "docs/evidence/training-runs.md").read_text()
    assert all(path.stat().st_size <= 400_000 for path in SHIPPED_POLICIES.glob("*/3/policy.safetensors"))


def imitation(recipe):
    """Returns the settings of the command `spikeserve imitate` of a recipe, as policies record them."""
    parser = argparse.ArgumentParser()
    add_command(parser.add_subparsers())
    command = re.search(r"^imitate .*$", recipe.replace("\\\n", " "), re.MULTILINE)
    words = shlex.split(command[0])
    common = re.search(r"^settings=\((.*?)\)$", (ROOT / "train/recipes/imitation.sh").read_text(), re.MULTILINE | re.DOTALL)
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
    recipe = (ROOT / "train/recipes" / f"{name}.sh").read_text()
    first = training(SHIPPED_POLICIES / name / "1/policy.safetensors")
    if "imitation" in first:
        recorded, of_recipe = with_settings_for_flags(first["imitation"]), imitation(recipe)
        # Settings that are younger than the policy are in the recipe only.
        assert recorded == {name: of_recipe[name] for name in recorded}
        return
    recorded = len(stages(SHIPPED_POLICIES / name / "1/policy.safetensors"))
    # A stage whose policy was replaced by a later one is in the recipe and not in the lineage.
    assert len(re.findall(r"^stage ", recipe, re.MULTILINE)) >= recorded


def test_recorded_commits_are_those_of_clean_checkouts():
    for path in FILES:
        for record in stages(path):
            assert re.fullmatch(r"[0-9a-f]{40}", record.get("commit", "0" * 40)), record["command"]
