"""Replies of Redis that come after the server has stopped waiting for them."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from links import Link
from redis_servers import WITHOUT_REDIS
from security import until
from stored_sessions import Restartable, decide, opening

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
