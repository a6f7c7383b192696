"""Agents whose calls are recorded take neither the time nor the disk of operators."""

import concurrent.futures
import fcntl
import json
import os
import pathlib
import re

import grpc
from security import ADMIN, POLICY, TOKENS, code_of, service_with, until
from serving import running_server

MEGABYTE = 1 << 20
LONG_ID = 60_000
EXPORTS = 400
THREADS = 8
CALLS = 40  # more than the server keeps waiting


def test_exports_do_not_stand_between_operators_and_their_calls(tmp_path):
    """A limit on the length of files stands for a full disk: agents fill as much as they may, and operators act."""
    tokens, log = tmp_path / "tokens.json", tmp_path / "audit.jsonl"
    any_rate = {"calls_per_second": {"operator": 0}}
    tokens.write_text(json.dumps(TOKENS | {"tenants": {name: any_rate for name in TOKENS["tenants"]}}))
    flags = [f"--tokens={tokens}", f"--audit_log={log}"]
    with (
        (tmp_path / "stderr").open("w") as stderr,
        running_server(flags=flags, log=stderr, prefix=["prlimit", f"--fsize={4 * MEGABYTE}:"]) as addresses,
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
        concurrent.futures.ThreadPoolExecutor(CALLS) as threads,
    ):
        fcntl.flock(held, fcntl.LOCK_EX)
        exports = [threads.submit(code_of, agent.ExportSession, session_id="missing") for _ in range(CALLS)]
        waiting = re.compile(rf"-> FLOCK .*:{os.fstat(held.fileno()).st_ino} ")
        until(lambda: waiting.search(pathlib.Path("/proc/locks").read_text()))
        assert code_of(operator.SetLabel, policy="cartpole", version=1, label="a") == grpc.StatusCode.OK
        fcntl.flock(held, fcntl.LOCK_UN)
        codes = {export.result() for export in exports}
    assert codes <= {grpc.StatusCode.NOT_FOUND, grpc.StatusCode.RESOURCE_EXHAUSTED, grpc.StatusCode.UNAVAILABLE}


def test_the_file_of_agents_is_rotated(tmp_path):
    log = tmp_path / "audit.jsonl"
    with running_server(flags=[f"--audit_log={log}"], log=(tmp_path / "stderr").open("w")) as addresses, service_with(addresses, None) as agent:
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
