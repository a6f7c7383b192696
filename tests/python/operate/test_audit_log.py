"""What operators change is recorded or not made, on a full disk, too, and the lines of the record are whole."""

import contextlib
import json
import subprocess

import grpc
import pytest
from security import code_of
from serving import running_server

CALLS = 60
LIMIT = 60_000  # bytes; room for some of the lines
OK, UNAVAILABLE = grpc.StatusCode.OK, grpc.StatusCode.UNAVAILABLE


@contextlib.contextmanager
def served(log, *flags, limit="unlimited"):
    flags = (f"--audit_log={log}", *flags)
    with running_server(flags=flags, prefix=["prlimit", f"--fsize={limit}:"]) as addresses:
        yield addresses.process, addresses.agent, addresses.admin


def entries(log):
    """Returns the lines of the record, each of which must be whole."""
    text = log.read_text()
    assert text.endswith("\n") or not text
    return [json.loads(line) for line in text.splitlines()]


def label(admin, i):
    return code_of(admin.SetLabel, policy="cartpole", version=1, label=f"label{i}")


def labels(agent):
    return {label for policy in agent.ListPolicies().policies for label in policy.version_labels}


def test_on_a_full_disk_nothing_changes_without_its_line(tmp_path):
    log = tmp_path / "audit.jsonl"
    with served(log, limit=LIMIT) as (process, agent, admin):
        codes = [label(admin, i) for i in range(CALLS)]
        assert set(codes) == {OK, UNAVAILABLE}
        made = [f"label{i}" for i in range(CALLS) if codes[i] == OK]
        assert labels(agent) == set(made)
        assert [line["request"]["label"] for line in entries(log)] == made
        with pytest.raises(grpc.RpcError) as refused:
            admin.Drain()
        assert refused.value.details().startswith(
            "--audit_log: expected room for a line, so nothing was changed: "
        )
        assert agent.OpenSession(policy="cartpole").version  # the server is not draining
        # With room again, changes are made again.
        subprocess.run(["prlimit", f"--pid={process.pid}", "--fsize=unlimited:"], check=True)
        assert label(admin, CALLS) == OK
        assert entries(log)[-1]["request"]["label"] == f"label{CALLS}"


def test_an_operator_may_allow_changes_that_are_not_recorded(tmp_path):
    log = tmp_path / "audit.jsonl"
    with served(log, "--allow_unrecorded_changes", limit=LIMIT) as (_, agent, admin):
        assert {label(admin, i) for i in range(CALLS)} == {OK}
        assert labels(agent) == {f"label{i}" for i in range(CALLS)}
        recorded = entries(log)
        assert 0 < len(recorded) < CALLS
        # The states are what a line loses first.
        assert recorded[0]["before"] is not None


def test_what_an_interrupted_write_has_left_is_removed(tmp_path):
    log = tmp_path / "audit.jsonl"
    with served(log) as (_, _, admin):
        assert label(admin, 1) == OK
        [first] = log.read_text().splitlines()
        with log.open("a") as file:
            file.write(first[: len(first) // 2])
        assert label(admin, 2) == OK
        assert [line["request"]["label"] for line in entries(log)] == ["label1", "label2"]
        # An editor may have left the end of a line out.
        log.write_text(log.read_text().removesuffix("\n"))
        assert label(admin, 3) == OK
        assert [line["request"]["label"] for line in entries(log)] == ["label1", "label2", "label3"]
