"""Writes that reach Redis late, on a connection that the server has given up, and writes that Redis has lost."""

import contextlib
import pathlib
import shutil
import socket
import threading

import grpc
import pytest
from redis_servers import WITHOUT_REDIS
from security import code_of, until
from stored_sessions import Restartable, acting, comparable, opening

pytestmark = WITHOUT_REDIS

SESSION = 5  # learns by itself, so that every answer waits for the store
TAKEN = 4  # decisions before the disturbance


class SlowRoute:
    """Forwards connections to Redis. From hold() on it keeps what comes on those that are open, until release()."""

    def __init__(self, port):
        self._target = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._mutex = threading.Lock()
        self._routes = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                route = _Route(client, socket.create_connection(self._target))
                with self._mutex:
                    self._routes.append(route)

    def hold(self):
        with self._mutex:
            for route in self._routes:
                route.open.clear()

    def release(self):
        """Forwards what was kept."""
        with self._mutex:
            for route in self._routes:
                route.open.set()
                route.forwarded.wait()

    def close(self):
        self._listener.close()
        with self._mutex:
            for route in self._routes:
                route.close()


class _Route:
    """One connection. `forwarded` is set while nothing is kept."""

    def __init__(self, client, redis):
        self._client, self._redis = client, redis
        self.open, self.forwarded = threading.Event(), threading.Event()
        self.open.set()
        self.forwarded.set()
        threading.Thread(target=self._forward, daemon=True).start()
        threading.Thread(target=self._answer, daemon=True).start()

    def _forward(self):
        with contextlib.suppress(OSError):
            while data := self._client.recv(1 << 16):
                if not self.open.is_set():
                    self.forwarded.clear()
                    self.open.wait()
                self._redis.sendall(data)
                self.forwarded.set()

    def _answer(self):
        with contextlib.suppress(OSError):
            while data := self._redis.recv(1 << 16):
                with contextlib.suppress(OSError):  # the server may have closed its side
                    self._client.sendall(data)
        self._client.close()

    def close(self):
        self.open.set()
        for side in (self._client, self._redis):
            with contextlib.suppress(OSError):
                side.shutdown(socket.SHUT_RDWR)


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
        server.close()
        return answers


@contextlib.contextmanager
def two_servers(port, other_port):
    """Starts a server on each of two ways to the same store."""
    with Restartable(f"redis://127.0.0.1:{port}") as first, Restartable(f"redis://127.0.0.1:{other_port}") as second:
        yield first, second
        first.close()
        second.close()


@pytest.mark.parametrize("released_after", [1, 3])
@pytest.mark.parametrize("held_before", [0, 2, TAKEN])  # the session is opened, decides, ends an episode
def test_what_redis_runs_late_changes_nothing(redis, undisturbed, held_before, released_after):
    """The server sends again what Redis did not acknowledge, continues, and Redis gets the first copy after that."""
    route = SlowRoute(redis.port)
    with contextlib.closing(route), two_servers(route.port, redis.port) as (first, second):
        first.OpenSession(policy="cartpole", durability="SYNC")  # so that there is a connection
        if held_before == 0:
            route.hold()
        open_session(first)
        answers = []
        for decision in range(TAKEN + 3):
            if decision == held_before > 0:
                route.hold()
            answers.append(decide(first, decision))
            if decision == held_before + released_after - 1:
                route.release()
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
