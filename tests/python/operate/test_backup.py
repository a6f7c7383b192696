"""Sessions go on from a backup of a file store or of Redis, made while a server uses it (docs/guides/upgrades.md)."""

import shutil
import subprocess

import grpc
import pytest
from redis_servers import DURABLE, WITHOUT_REDIS, Redis, stopping
from security import until
from serving import DEADLINE_SECONDS, TEST_TIME
from stored_sessions import Restartable, acting, comparable, expected_decision, opening

SESSION = 5  # learns by itself
BEFORE, AFTER = 20, 12


def play(server, steps):
    return [comparable(server.Act(**acting(SESSION, 0, step))) for step in steps]


def play_over_a_backup(store, backup, restored):
    """Plays, makes a backup, plays on, loses the store, and continues from the backup.

    A client that is ahead of the backup learns which decision the server expects, sends the later ones again, and gets the
    answers of before.
    """
    with Restartable(store) as server:
        server.OpenSession(**opening(SESSION))
        play(server, range(BEFORE))
        backup()
        lost = play(server, range(BEFORE, BEFORE + AFTER))
    with Restartable(restored()) as server:
        with pytest.raises(grpc.RpcError) as error:
            server.Act(**acting(SESSION, 0, BEFORE + AFTER))
        assert expected_decision(server.channel, error.value) == BEFORE
        assert play(server, range(BEFORE, BEFORE + AFTER)) == lost


WITHOUT_MDB_COPY = pytest.mark.skipif(shutil.which("mdb_copy") is None, reason="without mdb_copy of lmdb-utils")
WITH_EMULATED_LOCKS = pytest.mark.skipif(TEST_TIME > 1, reason="locks of an emulated server are not those of this machine's mdb_copy")


def copy_store(folder):
    """Copies `folder`/store to `folder`/backup while a server uses it."""
    (folder / "backup/usage").mkdir(parents=True)
    for part in (".", "usage"):
        subprocess.run(["mdb_copy", folder / "store" / part, folder / "backup" / part], check=True, timeout=DEADLINE_SECONDS)


@WITHOUT_MDB_COPY
@WITH_EMULATED_LOCKS
def test_a_file_store(tmp_path):
    def restored():
        shutil.rmtree(tmp_path / "store")
        shutil.copytree(tmp_path / "backup", tmp_path / "store")
        return f"file:{tmp_path}/store"

    play_over_a_backup(f"file:{tmp_path}/store", lambda: copy_store(tmp_path), restored)


@WITHOUT_MDB_COPY
@WITH_EMULATED_LOCKS
def test_the_ledger_of_a_file_store(tmp_path):
    """What a session has used is in the backup after its journal is gone."""
    with Restartable(f"file:{tmp_path}/store") as server:
        session = server.OpenSession(**opening(SESSION)).session_id
        play(server, range(BEFORE))
        server.CloseSession(session_id=session)
        copy_store(tmp_path)
    with Restartable(f"file:{tmp_path}/backup") as restored:
        (row,) = restored.admin.GetUsage().rows
        assert row.usage.decisions == BEFORE


def test_a_file_store_of_a_stopped_server(tmp_path):
    """Without mdb_copy: the folder is copied while no server uses it."""
    with Restartable(f"file:{tmp_path}/store") as server:
        server.OpenSession(**opening(SESSION))
        answers = play(server, range(BEFORE))
    shutil.copytree(tmp_path / "store", tmp_path / "restored")
    with Restartable(f"file:{tmp_path}/store") as before, Restartable(f"file:{tmp_path}/restored") as after:
        assert play(before, range(BEFORE, BEFORE + AFTER)) == play(after, range(BEFORE, BEFORE + AFTER))
        assert len(answers) == BEFORE


@WITHOUT_REDIS
def test_redis(tmp_path):
    """A Redis that appends to a log reads a dump only if it starts without the log; then it writes the log anew."""
    with stopping([Redis(*DURABLE, password=""), Redis(password="")]) as [lost, fresh]:

        def backup():
            lost.command("BGSAVE")
            until(lambda: b"rdb_bgsave_in_progress:0" in lost.command("INFO", "persistence"))
            shutil.copy(f"{lost.folder.name}/dump.rdb", tmp_path)

        def restored():
            lost.kill()
            fresh.kill()
            shutil.copy(tmp_path / "dump.rdb", fresh.folder.name)
            fresh.start()
            fresh.command("CONFIG", "SET", "appendonly", "yes")
            fresh.command("CONFIG", "SET", "appendfsync", "always")
            until(lambda: b"aof_rewrite_in_progress:0" in fresh.command("INFO", "persistence"))
            return f"redis://127.0.0.1:{fresh.port}"

        play_over_a_backup(f"redis://127.0.0.1:{lost.port}", backup, restored)
        # What came after the restoration is in the log.
        fresh.kill()
        fresh.program += DURABLE
        fresh.start()
        with Restartable(f"redis://127.0.0.1:{fresh.port}") as server:
            assert server.GetSession(**{"session_id": opening(SESSION)["session_id"]}).decisions == BEFORE + AFTER
