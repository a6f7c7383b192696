"""spikectl store check reads a session store and says what is wrong with it."""

import json
import os
import subprocess

import pytest
from redis_servers import PASSWORD, WITHOUT_REDIS, Redis, start_cluster, stopping
from security import until
from serving import DEADLINE_SECONDS
from stored_sessions import Restartable, acting, opening

SESSIONS = 6


def check(store, *flags):
    """Returns the exit status and the report."""
    program = os.environ["SPIKECTL_PROGRAM"]
    run = subprocess.run(
        [program, "store", "check", "--json", f"--session_store={store}", *flags],
        capture_output=True,
        text=True,
        timeout=DEADLINE_SECONDS,
    )
    return run.returncode, json.loads(run.stdout) if run.stdout else run.stderr


def play(server):
    for i in range(SESSIONS):
        server.OpenSession(**opening(i))
        for step in range(i + 1):
            server.Act(**acting(i, 0, step))


def names(findings):
    return {finding["name"] for finding in findings}


def test_a_file(tmp_path):
    folder = tmp_path / "store"
    with Restartable(f"file:{folder}") as server:
        play(server)
        status, report = check(f"file:{folder}")  # while the server uses it
        assert (status, report["open"], report["entries"]) == (0, SESSIONS, SESSIONS * (SESSIONS + 1) / 2)
        assert (report["damaged"], report["orphaned"]) == ([], [])
        server.kill()

        file = folder / "data.mdb"
        content = file.read_bytes()
        ids = [f"{i:032x}".encode() for i in range(SESSIONS)]
        name = b"spikeserve.session.v1"
        damaged = content.find(name)
        assert damaged > 0
        file.write_bytes(content[:damaged] + b"x" * len(name) + content[damaged + len(name) :])
        status, report = check(f"file:{folder}")
        assert status == 1
        assert len(report["damaged"]) == 1
        assert names(report["damaged"]) < {each.decode() for each in ids}
        server.restart()
        server.close()


def test_no_store(tmp_path):
    status, error = check(f"file:{tmp_path}/missing")
    assert status == 1
    assert "--session_store: expected a folder with a session store, received" in error
    status, error = check("disk")
    assert "--session_store: expected file:DIR, redis://" in error


@pytest.fixture
def password(tmp_path):
    path = tmp_path / "password"
    path.write_text(PASSWORD)
    return f"--store_password_file={path}"


@WITHOUT_REDIS
def test_redis(password):
    with stopping([Redis()]) as [redis]:
        store = f"redis://127.0.0.1:{redis.port}"
        with Restartable(store, [password]) as server:
            play(server)
            server.CloseSession(session_id=opening(5)["session_id"])
            status, report = check(store, password)
            assert (status, report["open"], report["closed"], report["owned"]) == (0, 5, 1, 5)
            assert (report["damaged"], report["orphaned"], len(report["replicas"])) == ([], [], 1)

            ids = [f"{i:032x}" for i in range(SESSIONS)]
            redis.command(f"DEL ss:{{{ids[0]}}}:1")  # a session without its journal
            redis.command(f"RPUSH ss:{{{ids[1]}}}:1 nonsense")  # a record that is none
            redis.command(f"LSET ss:{{{ids[2]}}}:1 2 duplicate")  # an entry that is missing
            redis.command(f"DEL ss:{{{ids[3]}}}:o")  # a journal without its session
            redis.command(f"RPUSH ss:{{{ids[4]}}}:77 old")  # a journal of another epoch
            status, report = check(store, password)
            assert status == 1
            assert names(report["damaged"]) == set(ids[:3])
            assert names(report["orphaned"]) == {f"ss:{{{ids[3]}}}:1", f"ss:{{{ids[4]}}}:77"}

            server.kill()
            until(lambda: check(store, password)[1]["replicas"] == [])
            assert check(store, password)[1]["ownerless"] == 4
        status, error = check(store)
        assert (status, "NOAUTH" in error) == (1, True)


@WITHOUT_REDIS
def test_a_cluster(password):
    with stopping([]) as servers:
        start_cluster(servers)
        store = f"redis://127.0.0.1:{servers[0].port}"
        with Restartable(store, [password]) as server:
            play(server)
            status, report = check(store, password)
            assert (status, report["open"], report["damaged"], report["orphaned"]) == (0, SESSIONS, [], [])
            server.close()
