"""What operators change is recorded or not made, on a full disk, too, and the lines of the record are whole."""

import concurrent.futures
import contextlib
import fcntl
import json
import os
import pathlib
import re
import subprocess

import grpc
import pytest
from security import ADMIN, POLICY, TOKENS, code_of, service_with, until
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


MEGABYTE = 1 << 20
LONG_ID = 60_000
EXPORTS = 400
THREADS = 8
WAITING_CALLS = 40  # more than the server keeps waiting


def test_exports_do_not_stand_between_operators_and_their_calls(tmp_path):
    """A limit on the length of files stands for a full disk: agents fill as much as they may, and operators act."""
    tokens, log = tmp_path / "tokens.json", tmp_path / "audit.jsonl"
    any_rate = {"calls_per_second": {"operator": 0}}
    tokens.write_text(json.dumps(TOKENS | {"tenants": {name: any_rate for name in TOKENS["tenants"]}}))
    flags = [f"--tokens={tokens}", f"--audit_log={log}"]
    with (
        running_server(flags=flags, log=tmp_path / "stderr", prefix=["prlimit", f"--fsize={4 * MEGABYTE}:"]) as addresses,
        service_with(addresses, "agent", POLICY) as agent,
        service_with(addresses, "machine", ADMIN) as operator,
    ):
        with concurrent.futures.ThreadPoolExecutor(THREADS) as threads:
            codes = list(threads.map(lambda _: code_of(agent.ExportSession, session_id="x" * LONG_ID), range(EXPORTS)))
        assert grpc.StatusCode.NOT_FOUND in codes and grpc.StatusCode.DATA_LOSS not in codes
        assert code_of(operator.SetLabel, policy="cartpole", version=1, label="after") == grpc.StatusCode.OK
    [line] = [json.loads(line) for line in log.read_text().splitlines()]
    assert line["action"] == "SetLabel"
    agents = log.with_name("audit.jsonl.agents").read_text().splitlines()
    assert min(json.loads(line)["request"]["bytes"] for line in agents) > LONG_ID
    assert max(map(len, agents)) < 20_000


def test_a_disk_that_agents_wait_for_does_not_stop_operators(tmp_path):
    """A lock on the file of agents stands for a disk that does not answer."""
    log = tmp_path / "audit.jsonl"
    with (
        log.with_name("audit.jsonl.agents").open("w") as held,
        running_server(flags=[f"--audit_log={log}"]) as addresses,
        service_with(addresses, None) as agent,
        service_with(addresses, None, ADMIN) as operator,
        concurrent.futures.ThreadPoolExecutor(WAITING_CALLS) as threads,
    ):
        fcntl.flock(held, fcntl.LOCK_EX)
        exports = [threads.submit(code_of, agent.ExportSession, session_id="missing") for _ in range(WAITING_CALLS)]
        waiting = re.compile(rf"-> FLOCK .*:{os.fstat(held.fileno()).st_ino} ")
        until(lambda: waiting.search(pathlib.Path("/proc/locks").read_text()))
        assert code_of(operator.SetLabel, policy="cartpole", version=1, label="a") == grpc.StatusCode.OK
        fcntl.flock(held, fcntl.LOCK_UN)
        codes = {export.result() for export in exports}
    assert codes <= {grpc.StatusCode.NOT_FOUND, grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.UNAVAILABLE}


def test_the_file_of_agents_is_rotated(tmp_path):
    log = tmp_path / "audit.jsonl"
    with running_server(flags=[f"--audit_log={log}"], log=tmp_path / "stderr") as addresses, service_with(addresses, None) as agent:
        older = log.with_name("audit.jsonl.agents")
        older.write_text("{}\n" * (3 * MEGABYTE))  # above the limit
        assert code_of(agent.ExportSession, session_id="missing") == grpc.StatusCode.NOT_FOUND
        assert len(older.read_text().splitlines()) == 1
        assert log.with_name("audit.jsonl.agents.1").stat().st_size == 9 * MEGABYTE


def test_a_full_disk_removes_no_lines(tmp_path):
    log = tmp_path / "audit.jsonl"
    older = log.with_name("audit.jsonl.agents")
    older.write_text("{}\n" * (MEGABYTE // 3))
    kept = older.stat().st_size
    prefix = ["prlimit", f"--fsize={MEGABYTE}:"]
    with running_server(flags=[f"--audit_log={log}"], prefix=prefix) as addresses, service_with(addresses, None) as agent:
        for _ in range(3):
            assert code_of(agent.ExportSession, session_id="missing") == grpc.StatusCode.NOT_FOUND
    assert older.stat().st_size == kept and not log.with_name("audit.jsonl.agents.1").exists()


def test_a_reserve_is_kept_for_operators(tmp_path):
    """Blocks behind the end of the file, which the disk keeps for it."""
    log = tmp_path / "audit.jsonl"
    with running_server(flags=[f"--audit_log={log}"]) as addresses, service_with(addresses, None, ADMIN) as operator:
        assert code_of(operator.SetLabel, policy="cartpole", version=1, label="a") == grpc.StatusCode.OK
        stat = log.stat()
        assert stat.st_size < MEGABYTE <= 512 * stat.st_blocks
