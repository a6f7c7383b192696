"""Follows how every shipped policy came to be, from its file to its first stage."""

import json
import re

import pytest
from policy_file import read_policy
from serving import SHIPPED_POLICIES

FILES = sorted(SHIPPED_POLICIES.glob("*/*/policy.safetensors"))
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


@pytest.mark.parametrize("path", FILES, ids=lambda path: "/".join(path.parts[-3:-1]))
def test_a_shipped_policy_is_small_in_integers_and_was_played(path):
    record = training(path)
    made_for_integers = {"quantize": "--to=integer", "train": "--arithmetic=integer"}[record["command"].split()[1]]
    assert made_for_integers in record["command"]
    assert SHA256.fullmatch(record["parent_sha256"]), "the policy in float32"
    assert record["evaluation"]["first_seed"] == 2_000_000, "starts that no training saw"
    assert record["evaluation"]["episodes"] >= 300
    assert path.stat().st_size <= 410_000


def test_the_shipped_set_is_one_that_a_user_would_choose():
    assert len(NAMES) <= 9
    assert len(list((SHIPPED_POLICIES / "cartpole").iterdir())) == 2, "to try labels and canaries with"


def test_recorded_commits_are_those_of_clean_checkouts():
    for path in FILES:
        for record in stages(path):
            assert re.fullmatch(r"[0-9a-f]{40}", record.get("commit", "0" * 40)), record["command"]
