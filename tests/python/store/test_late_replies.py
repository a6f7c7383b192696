"""Replies of Redis that come after the server has stopped waiting for them."""

import contextlib
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
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


class LateRoute:
    """Forwards connections to Redis.

    hold(): replies to the next command with a marker, and to what was sent with it, are kept until the server sends
    another command on this connection, or gives it up.
    """

    def __init__(self, port):
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._mutex = threading.Lock()
        self._marker = None
        self._sockets = []
        self.held = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def hold(self, marker):
        with self._mutex:
            self._marker = marker

    def drop(self):
        """Ends all connections that are open."""
        with self._mutex:
            sockets, self._sockets = self._sockets, []
        for each in sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def close(self):
        self._listener.close()
        self.drop()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                redis = socket.create_connection(self._target)
                with self._mutex:
                    self._sockets += [client, redis]
                is_open = threading.Event()
                is_open.set()
                for forward in (self._commands, self._replies):
                    threading.Thread(target=forward, args=(client, redis, is_open), daemon=True).start()

    def _is_to_be_held(self, data):
        with self._mutex:
            if self._marker is None or self._marker not in data:
                return False
            self._marker = None
            return True

    def _commands(self, client, redis, is_open):
        with contextlib.suppress(OSError):
            while data := client.recv(1 << 20):
                is_open.set()
                if self._is_to_be_held(data):
                    is_open.clear()
                    self.held.set()
                redis.sendall(data)
        is_open.set()
        with contextlib.suppress(OSError):
            redis.shutdown(socket.SHUT_RDWR)

    def _replies(self, client, redis, is_open):
        with contextlib.suppress(OSError):
            while data := redis.recv(1 << 16):
                is_open.wait()
                client.sendall(data)
        with contextlib.suppress(OSError):
            client.shutdown(socket.SHUT_RDWR)


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
        server.close()
        return answers


@pytest.mark.parametrize("command", COMMANDS)
def test_late_replies_are_not_taken_for_those_of_other_commands(redis, undisturbed, command):
    route = LateRoute(redis.port)
    with (
        contextlib.closing(route),
        Restartable(f"redis://127.0.0.1:{redis.port}") as other,
        Restartable(f"redis://127.0.0.1:{route.port}", ["--store_timeout=300ms"]) as server,
    ):
        for i in SESSIONS:
            until(lambda i=i: server.OpenSession(**opening(i)).session_id != "")
        answers = [decide_all(server, decision) for decision in range(BEFORE)]
        answers.append(decide_all(other, BEFORE))
        route.hold(COMMANDS[command])
        if command == "read a setting":
            route.drop()
        # The copies here are old ones: their records are refused, and the sessions are claimed.
        assert decide_all(server, BEFORE) == answers[-1]
        until(route.held.is_set)
        answers += [decide_all(each, BEFORE + n) for n, each in enumerate((server, other, server), 1)]
        assert answers == undisturbed
        server.kill()
        other.kill()
