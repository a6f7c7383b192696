"""A Redis that answers nonsense, or is none, harms nothing but the sessions that need it."""

import contextlib
import http.server
import os
import socket
import socketserver
import subprocess
import threading

import grpc
import pytest
from security import until
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, running_server
from stored_sessions import opening

NIL = b"$-1\r\n"
OK = b"+OK\r\n"
NO_CLUSTER = b"-ERR This instance has cluster support disabled\r\n"
NOTHING = b""  # the command is never answered


def integer(value):
    return b":%d\r\n" % value


def string(value):
    return b"$%d\r\n%s\r\n" % (len(value), value)


def array(*items):
    return b"*%d\r\n%s" % (len(items), b"".join(items))


def primary(command):
    """Answers what a single primary does that has nothing, and whose scripts return 0."""
    answers = {
        b"CLUSTER": NO_CLUSTER,
        b"ROLE": array(string(b"master"), integer(0), array()),
        b"HMGET": array(*[NIL] * (len(command) - 2)),
        b"EVAL": integer(0),
        b"GET": NIL,
        b"PING": string(command[-1]),
    }
    return answers.get(command[0], OK)


class _Connection(socketserver.StreamRequestHandler):
    def handle(self):
        with contextlib.suppress(OSError, ValueError):
            while line := self.rfile.readline():
                command = []
                for _ in range(int(line[1:])):
                    size = int(self.rfile.readline()[1:])
                    command.append(self.rfile.read(size + 2)[:-2])
                self.server.commands.append(command)
                self.wfile.write(self.server.answer(command))


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True


class FakeRedis:
    """Answers each command, a list of bytes, with `answer(command)`. `commands` are those that have arrived."""

    def __init__(self, answer=primary):
        self._server = _Server(("127.0.0.1", 0), _Connection)
        self._server.answer = answer
        self.commands = self._server.commands = []
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def port(self):
        return self._server.server_address[1]

    @property
    def url(self):
        return f"redis://127.0.0.1:{self.port}"

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._server.shutdown()
        self._server.server_close()


LARGEST = 2**63 - 1


def slots(first, last, port=6379):
    """Returns the answer to CLUSTER SLOTS of a Cluster with one node."""
    return array(array(integer(first), integer(last), array(string(b"127.0.0.1"), integer(port))))


def to_cluster_slots(answer):
    return lambda command: answer if command[0] == b"CLUSTER" else primary(command)


def to_scripts(answer):
    return lambda command: answer if command[0] == b"EVAL" else primary(command)


def starts_with(url, log, *flags):
    """Asserts that a server starts, serves sessions without a store and refuses others. Returns its log."""
    flags = [f"--session_store={url}", *flags]
    with running_server(flags=flags, log=log) as addresses:
        with pytest.raises(grpc.RpcError) as error:
            addresses.agent.OpenSession(**opening(0))
        # A script that always answers 0 says that the session exists.
        assert error.value.code() in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.ALREADY_EXISTS)
        session = addresses.agent.OpenSession(policy="cartpole", durability="NONE").session_id
        assert addresses.agent.Act(session_id=session, observation=[0.0] * 4).step == 0
    return log.read_text()


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        (to_cluster_slots(slots(-1, 100)), "expected slots from 0 to 16383, received -1 to 100"),
        (to_cluster_slots(slots(0, LARGEST)), f"expected slots from 0 to 16383, received 0 to {LARGEST}"),
        (to_cluster_slots(slots(LARGEST, -1)), "expected slots from 0 to 16383"),
        (to_cluster_slots(slots(0, 16383, port=LARGEST)), f"expected a port from 1 to 65535, received {LARGEST}"),
        (to_cluster_slots(b"*2147483647\r\n"), "a reply is too large"),
        (to_cluster_slots(b"*1048576\r\n*1048576\r\n"), "a reply is too large"),
        (to_scripts(b"*2147483647\r\n"), "a reply is too large"),
        (to_scripts(b"$2147483647\r\n"), "session store not reached"),
        (to_scripts(integer(0)), "the store has no settings and takes none"),
        (to_scripts(array(*[NIL] * 5)), "shared heads not taken from their log"),
    ],
)
def test_replies_that_make_no_sense(tmp_path, answer, expected):
    with FakeRedis(answer) as redis:
        assert expected in starts_with(redis.url, tmp_path / "log")


@pytest.mark.parametrize("reply", [b"*2147483647\r\n", b"$2147483647\r\n" + b"x" * 100])
def test_a_reply_that_never_ends(tmp_path, reply):
    """It arrives in small parts, each of which comes in time."""
    ends = threading.Event()

    def drip(connection):
        connection.recv(1 << 16)
        connection.sendall(reply)
        while not ends.wait(0.02):
            connection.sendall(b"x")

    with listening(drip) as url:
        assert "not reached" in starts_with(url, tmp_path / "log", "--store_timeout=100ms")
        ends.set()


class listening:
    """Accepts connections and calls `talk` for each on a thread. Yields the address of a store there."""

    def __init__(self, talk):
        self._talk = talk
        self._listener = socket.create_server(("127.0.0.1", 0))

    def __enter__(self):
        threading.Thread(target=self._accept, daemon=True).start()
        return f"redis://127.0.0.1:{self._listener.getsockname()[1]}"

    def _accept(self):
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection):
        with connection:
            try:
                self._talk(connection)
            except OSError:
                return

    def __exit__(self, *error):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()


def test_an_http_server_is_named_as_such(tmp_path):
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_address[1]
        log = starts_with(f"redis://127.0.0.1:{port}", tmp_path / "log")
        server.shutdown()
    assert f"--session_store: expected a Redis server at 127.0.0.1:{port}, received " in log
    assert "<!DOCTYPE HTML" in log or "HTTP/1" in log


def ended_by(start, url, flags=(), signal="terminate"):
    """Starts a server, waits for `start()`, ends the server by a signal and returns its status."""
    program = [os.environ["SPIKESERVE_PROGRAM"], f"--policies={SHIPPED_POLICIES}", "--listen=127.0.0.1:0"]
    server = subprocess.Popen([*program, "--http_listen=", f"--session_store={url}", *flags], stderr=subprocess.DEVNULL)
    try:
        start()
        getattr(server, signal)()
        return server.wait(timeout=DEADLINE_SECONDS)
    finally:
        server.kill()
        server.wait()


def test_sigterm_while_the_store_says_nothing():
    """The server waits for the first answer of the store when it is told to stop."""
    with FakeRedis(lambda command: NOTHING) as redis:
        assert ended_by(lambda: until(lambda: redis.commands), redis.url, ["--store_timeout=10m"]) == 0


def test_sigterm_while_the_settings_are_read():
    def answer(command):
        return NOTHING if command[0] == b"HMGET" else primary(command)

    with FakeRedis(answer) as redis:

        def reading():
            until(lambda: any(command[0] == b"HMGET" for command in redis.commands))

        assert ended_by(reading, redis.url, ["--store_timeout=10m"]) == 0
