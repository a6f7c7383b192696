"""Follows how every shipped policy came to be, from its file to its first stage."""

import hashlib
import json
import re

import pytest
from policy_file import read_policy
from serving import DEPLOY, SHIPPED_POLICIES

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


def test_recorded_commits_are_those_of_clean_checkouts():
    for path in FILES:
        for record in stages(path):
            assert re.fullmatch(r"[0-9a-f]{40}", record.get("commit", "0" * 40)), record["command"]
