"""Replies of Redis, and writes in it, that come after the server has stopped waiting for them."""

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from links import Link
from redis_servers import WITHOUT_REDIS
from security import code_of, until
from stored_sessions import Restartable, acting, comparable, decide, opening

pytestmark = WITHOUT_REDIS

SESSIONS = [0, 1, 4, 5]  # two that are frozen, two that learn by themselves, on two policies
BEFORE = 3  # decisions before the disturbance
ALL = BEFORE + 4

# What is in the command whose reply comes late.
COMMANDS = {
    "find a session": b"\r\ntenant\r\n",
    "claim a session": b"if #records == 0 then return false",
    "find why a record was refused": b"\r\nowner\r\n",
    "read a setting": b"CONFIG",
}


class LateRoute(Link):
    """Keeps the replies to the next command with `marker`, and to what was sent with it.

    They are forwarded when the server sends another command on this connection, or gives it up.
    """

    def __init__(self, target):
        super().__init__(target)
        self.marker = None
        self.held = threading.Event()

    def pieces(self, pipe):
        for data in super().pieces(pipe):
            if pipe.answers is not None:
                self._hold(pipe.answers, data)
            yield data
        if pipe.answers is not None:
            self._hold(pipe.answers, b"")

    def _hold(self, answers, data):
        with self.changed:
            answers.is_forgotten = self.marker is not None and self.marker in data
            if answers.is_forgotten:
                self.marker = None
                self.held.set()
            self.changed.notify_all()


def decide_all(server, decision):
    """Lets all sessions decide at once, so that the server claims and writes them together."""
    with ThreadPoolExecutor(len(SESSIONS)) as pool:
        return list(pool.map(lambda i: decide(server, i, decision), SESSIONS))


@pytest.fixture(scope="module")
def undisturbed():
    with Restartable("memory") as server:
        for i in SESSIONS:
            server.OpenSession(**opening(i) | {"durability": "NONE"})
        answers = [decide_all(server, decision) for decision in range(ALL)]
        return answers


@pytest.mark.parametrize("command", COMMANDS)
def test_late_replies_are_not_taken_for_those_of_other_commands(redis, undisturbed, command):
    with (
        LateRoute(f"127.0.0.1:{redis.port}") as route,
        Restartable(f"redis://127.0.0.1:{redis.port}") as other,
        Restartable(f"redis://127.0.0.1:{route.port}", ["--store_timeout=300ms"]) as server,
    ):
        for i in SESSIONS:
            until(lambda i=i: server.OpenSession(**opening(i)).session_id != "")
        answers = [decide_all(server, decision) for decision in range(BEFORE)]
        answers.append(decide_all(other, BEFORE))
        route.marker = COMMANDS[command]
        if command == "read a setting":
            route.drop()
        # The copies here are old ones: their records are refused, and the sessions are claimed.
        assert decide_all(server, BEFORE) == answers[-1]
        until(route.held.is_set)
        answers += [decide_all(each, BEFORE + n) for n, each in enumerate((server, other, server), 1)]
        assert answers == undisturbed
        server.kill()
        other.kill()


SESSION = 5  # learns by itself, so that every answer waits for the store
TAKEN = 4  # decisions before the disturbance


def decide_to_the_end(server, decision):
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
def undisturbed_session():
    with Restartable("memory") as server:
        open_session(server, durability="NONE")
        answers = [decide_to_the_end(server, decision) for decision in range(2 * TAKEN)]
        return answers


@contextlib.contextmanager
def two_servers(port, other_port):
    """Starts a server on each of two ways to the same store."""
    with Restartable(f"redis://127.0.0.1:{port}") as first, Restartable(f"redis://127.0.0.1:{other_port}") as second:
        yield first, second


@pytest.mark.parametrize("released_after", [1, 3])
@pytest.mark.parametrize("held_before", [0, 2, TAKEN])  # the session is opened, decides, ends an episode
def test_what_redis_runs_late_changes_nothing(redis, undisturbed_session, held_before, released_after):
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
            answers.append(decide_to_the_end(first, decision))
            if decision == held_before + released_after - 1:
                route.remember()
                assert redis.command("PING") == b"PONG"  # Redis has run what came before
        first.kill()
        answers.append(decide_to_the_end(second, TAKEN + 3))
        assert answers == undisturbed_session
