"""Writes that reach Redis late, on a connection that the server has given up, and writes that Redis has lost."""

import contextlib
import pathlib
import shutil

import grpc
import pytest
from links import Link
from redis_servers import WITHOUT_REDIS
from security import code_of, until
from stored_sessions import Restartable, acting, comparable, opening

pytestmark = WITHOUT_REDIS

SESSION = 5  # learns by itself, so that every answer waits for the store
TAKEN = 4  # decisions before the disturbance


def decide(server, decision):
    """Returns what the session answers, which must come in the end. It ends its first episode on the way."""
    if decision == TAKEN:
        ending = {"session_id": f"{SESSION:032x}", "reward": 1.0, "episode": 0, "steps": TAKEN}
        until(lambda: code_of(server.EndEpisode, **ending) == grpc.StatusCode.OK)
    request = acting(SESSION, 0, decision % TAKEN) | {"decision": decision}
    until(lambda: code_of(server.Act, **request) == grpc.StatusCode.OK)
    return comparable(server.Act(**request))


def open_session(server, **fields):
    until(lambda: code_of(server.OpenSession, **opening(SESSION) | fields) == grpc.StatusCode.OK)


@pytest.fixture(scope="module")
def undisturbed():
    with Restartable("memory") as server:
        open_session(server, durability="NONE")
        answers = [decide(server, decision) for decision in range(2 * TAKEN)]
        return answers


@contextlib.contextmanager
def two_servers(port, other_port):
    """Starts a server on each of two ways to the same store."""
    with Restartable(f"redis://127.0.0.1:{port}") as first, Restartable(f"redis://127.0.0.1:{other_port}") as second:
        yield first, second


@pytest.mark.parametrize("released_after", [1, 3])
@pytest.mark.parametrize("held_before", [0, 2, TAKEN])  # the session is opened, decides, ends an episode
def test_what_redis_runs_late_changes_nothing(redis, undisturbed, held_before, released_after):
    """The server sends again what Redis did not acknowledge, continues, and Redis gets the first copy after that."""
    with Link(f"127.0.0.1:{redis.port}") as route, two_servers(route.port, redis.port) as (first, second):
        first.OpenSession(policy="cartpole", durability="SYNC")  # so that there is a connection
        if held_before == 0:
            route.forget()
        open_session(first)
        answers = []
        for decision in range(TAKEN + 3):
            if decision == held_before > 0:
                route.forget()
            answers.append(decide(first, decision))
            if decision == held_before + released_after - 1:
                route.remember()
                assert redis.command("PING") == b"PONG"  # Redis has run what came before
        first.kill()
        answers.append(decide(second, TAKEN + 3))
        assert answers == undisturbed


def test_records_that_redis_has_lost_are_written_again(redis, undisturbed):
    """Redis comes back with its files of some decisions ago, as after a crash of its machine."""
    files = pathlib.Path(redis.folder.name) / "appendonlydir"
    with two_servers(redis.port, redis.port) as (first, second):
        open_session(first)
        answers = [decide(first, decision) for decision in range(TAKEN + 1)]
        shutil.copytree(files, files.with_name("before"))
        answers.append(decide(first, TAKEN + 1))
        redis.kill()
        shutil.rmtree(files)
        files.with_name("before").rename(files)
        redis.start()
        answers.append(decide(first, TAKEN + 2))
        first.kill()
        answers.append(decide(second, TAKEN + 3))
        assert answers == undisturbed
