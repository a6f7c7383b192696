"""spikectl store check reads a session store and shows what is wrong with it."""

import json
import os
import struct

import grpc
import pytest
from redis_servers import WITHOUT_REDIS, Redis, start_cluster, stopping
from security import code_of, until
from serving import refusal_at_start, run
from stored_sessions import Restartable, acting, comparable, expected_decision, opening

SESSIONS = 6


def check(store, *flags, prefix=()):
    """Returns the exit status and the report. `prefix` is a command that runs spikectl."""
    program = os.environ["SPIKECTL_PROGRAM"]
    done = run(*prefix, program, "store", "check", "--json", f"--session_store={store}", *flags, status=None)
    return done.returncode, json.loads(done.stdout) if done.stdout else done.stderr


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


def flip(file, part):
    """Changes one bit of all occurrences of `part` in a file. LMDB leaves older ones in pages that it has freed."""
    content = file.read_bytes()
    assert part in content
    file.write_bytes(content.replace(part, part[:-1] + bytes([part[-1] ^ 1])))


def first_number(step):
    """Returns the first number of an observation as CBOR writes it."""
    return b"\xfa" + struct.pack(">f", acting(0, 0, step)["observation"][0])


def test_the_end_of_a_journal_is_cut_off_where_it_is_damaged(tmp_path):
    """A bit of the last entry changes, which is still a document. The client sends the decision again."""
    folder, log = tmp_path / "store", tmp_path / "log"
    with Restartable(f"file:{folder}", log=log) as server:
        server.OpenSession(**opening(0))
        answers = [comparable(server.Act(**acting(0, 0, step))) for step in range(5)]
        server.kill()
        flip(folder / "data.mdb", first_number(4))
        status, report = check(f"file:{folder}")
        assert (status, names(report["damaged"])) == (1, {opening(0)["session_id"]})
        assert "expected its checksum" in report["damaged"][0]["reason"]

        server.restart()
        with pytest.raises(grpc.RpcError) as error:
            server.Act(**acting(0, 0, 5))
        assert expected_decision(server.channel, error.value) == 4
        assert "end of a journal cut off" in log.read_text()
        assert comparable(server.Act(**acting(0, 0, 4))) == answers[4]
        server.Act(**acting(0, 0, 5))
        assert check(f"file:{folder}")[0] == 0
        server.kill()

        # An entry before others cannot be cut off, and is not served.
        flip(folder / "data.mdb", first_number(4))
        server.restart()
        assert code_of(server.GetSession, session_id=opening(0)["session_id"]) == grpc.StatusCode.DATA_LOSS


def test_a_process_that_may_not_map_the_largest_store(tmp_path):
    with Restartable(f"file:{tmp_path}/store") as server:
        play(server)
    status, report = check(f"file:{tmp_path}/store", prefix=["prlimit", f"--as={16 << 30}"])
    assert (status, report["open"]) == (0, SESSIONS)


def test_a_file_whose_end_is_missing(tmp_path):
    """Neither the server nor spikectl serves what is left, and both say so."""
    folder = tmp_path / "store"
    with Restartable(f"file:{folder}") as server:
        play(server)
    # The first two pages name the others.
    os.truncate(folder / "data.mdb", 2 * os.sysconf("SC_PAGE_SIZE"))
    status, error = check(f"file:{folder}")
    assert status == 1
    assert "its end is missing" in error
    said = refusal_at_start(f"--session_store=file:{folder}")
    assert f"--session_store: {folder}/data.mdb: expected" in said
    assert "none that can be read" in said


def test_no_store(tmp_path):
    status, error = check(f"file:{tmp_path}/missing")
    assert status == 1
    assert "--session_store: expected a folder with a session store, received" in error
    status, error = check("disk")
    assert "--session_store: expected file:DIR, redis://" in error


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
            lists = [f"ss:{{{id}}}:" + redis.command(f"HGET ss:{{{id}}}:o epoch").decode() for id in ids[:4]]
            redis.command(f"DEL {lists[0]}")  # a session without its journal
            redis.command(f"RPUSH {lists[1]} nonsense")  # a record that is none
            redis.command(f"LSET {lists[2]} 2 duplicate")  # an entry that is missing
            redis.command(f"DEL ss:{{{ids[3]}}}:o")  # a journal without its session
            redis.command(f"RPUSH ss:{{{ids[4]}}}:77 old")  # a journal of another epoch
            status, report = check(store, password)
            assert status == 1
            assert names(report["damaged"]) == set(ids[:3])
            assert names(report["orphaned"]) == {lists[3], f"ss:{{{ids[4]}}}:77"}

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
