"""Strangers who hold many connections do not keep clients with a token out."""

import contextlib
import os
import socket
import subprocess
import sys
import time

import grpc
import pytest
from security import OBSERVATION, POLICY, code_of, service_with, tls_flags, until
from serving import metric, running_server

from tests.attacks import frames

MOST = 40  # connections of the server
HOSTS = 250  # addresses of a /24


class Stranger:
    """A connection with one call that is refused for its token, which it holds open."""

    def __init__(self, address, source, token="wrong"):
        host, _, port = address.rpartition(":")
        self.socket = socket.create_connection(
            (host.strip("[]"), int(port)), timeout=30, source_address=(source, 0)
        )
        fields = frames.request(f"/{POLICY}/ListPolicies", ("authorization", f"Bearer {token}"))
        self.socket.sendall(
            frames.PREFACE
            + frames.settings()
            + frames.frame(frames.HEADERS, fields, frames.END_HEADERS, 1)
            + frames.frame(frames.DATA, frames.framed(b""), frames.END_STREAM, 1)
        )

    def wait(self):
        """Waits for the answer to the call, or for the end of the connection."""
        received = b""
        with contextlib.suppress(OSError):
            while chunk := self.socket.recv(1 << 16):
                received += chunk
                while len(received) >= 9:
                    if received[3] == frames.HEADERS:
                        return
                    received = received[9 + int.from_bytes(received[:3]) :]

    def is_open(self):
        """Returns whether the server holds the connection."""
        with contextlib.suppress(BlockingIOError):
            self.socket.setblocking(False)
            try:
                while self.socket.recv(1 << 16):
                    pass
            except ConnectionError:
                pass
            return False
        return True


@contextlib.contextmanager
def strangers(address, sources):
    """Opens a Stranger from each source."""
    opened = []
    try:
        for source in sources:
            opened.append(Stranger(address, source))
        for stranger in opened:
            stranger.wait()
        yield opened
    finally:
        for stranger in opened:
            stranger.socket.close()


@contextlib.contextmanager
def known(address, sources):
    """Opens a connection from each source and makes a call on it that is admitted."""
    with contextlib.ExitStack() as stack:
        connections = []
        for source in sources:
            connections.append(Stranger(address, source, "agent"))
            stack.enter_context(contextlib.closing(connections[-1].socket))
            connections[-1].wait()
        yield connections


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def small(tokens, log):
    with running_server(
        flags=[f"--tokens={tokens}", f"--max_connections={MOST}"], log=log
    ) as addresses:
        yield addresses


def hosts(network, count):
    """Returns addresses of this machine in a /24."""
    return [f"127.0.{network}.{1 + i % HOSTS}" for i in range(count)]


def test_strangers_hold_no_place_that_a_client_needs(small, log):
    with strangers(small.grpc, hosts(7, MOST)) as crowd:
        with service_with(small, "agent") as agent:
            session = agent.OpenSession(policy="cartpole").session_id
            agent.Act(session_id=session, step=0, observation=OBSERVATION)
            with strangers(small.grpc, hosts(8, 3 * MOST)):
                agent.Act(session_id=session, step=1, observation=OBSERVATION)
            assert metric(small, "spikeserve_connections", token="viewer", state="known") == 1
            assert metric(small, "spikeserve_connections", token="viewer", state="unauthenticated") <= 3 * MOST / 4
            assert metric(small, "spikeserve_connections_limit", token="viewer") == MOST
            dropped = metric(small, "spikeserve_connections_dropped_total", token="viewer", limit="reserve")
            assert dropped >= 2 * MOST
        assert not all(stranger.is_open() for stranger in crowd)
    assert 'unauthenticated connection dropped client="127.0.' in log.read_text()


def test_a_crowd_of_one_network_makes_room_for_strangers_of_others(small):
    with strangers(small.grpc, ["127.0.9.1"]) as alone, strangers(small.grpc, hosts(7, 4 * MOST)):
        assert all(stranger.is_open() for stranger in alone)


def test_known_connections_are_refused_above_the_limit(small):
    with known(small.grpc, hosts(7, MOST)) as admitted:
        assert metric(small, "spikeserve_connections", token="viewer", state="known") == MOST
        with strangers(small.grpc, ["127.0.8.1"]) as late:
            until(lambda: not late[0].is_open())
        assert all(connection.is_open() for connection in admitted)
    assert metric(small, "spikeserve_connections_refused_total", token="viewer", limit="max_connections") >= 1


def test_a_network_has_a_share(tokens):
    flags = [f"--tokens={tokens}", "--max_connections_per_network=10"]
    with running_server(flags=flags) as addresses:
        with known(addresses.grpc, hosts(7, 10)):
            with strangers(addresses.grpc, ["127.0.7.99"]) as late:
                until(lambda: not late[0].is_open())
            with service_with(addresses, "agent") as agent:  # from 127.0.0.1
                assert code_of(agent.ListPolicies) == grpc.StatusCode.OK


def test_the_memory_of_strangers_is_bounded(tokens):
    budget = 4 << 20
    flags = [f"--tokens={tokens}", f"--max_unauthenticated_bytes={budget}"]
    with running_server(flags=flags) as addresses, strangers(addresses.grpc, hosts(7, 1000)) as crowd:
        until(lambda: metric(addresses, "spikeserve_bytes_in_flight", token="viewer", of="unauthenticated") <= budget)
        assert sum(stranger.is_open() for stranger in crowd) < 400
        with service_with(addresses, "agent") as agent:
            assert code_of(agent.ListPolicies) == grpc.StatusCode.OK


@contextlib.contextmanager
def open_stream(address):
    """Opens a call of ActStream by hand and yields its socket."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=30) as connection:
        fields = frames.request(f"/{POLICY}/ActStream", ("authorization", "Bearer agent"))
        connection.sendall(
            frames.PREFACE
            + frames.settings()
            + frames.frame(frames.HEADERS, fields, frames.END_HEADERS, 1)
        )
        yield connection


def read_frames(connection):
    """Yields the frames that the server sends as (kind, flags, payload) until it ends the connection."""
    received = b""
    with contextlib.suppress(ConnectionError):
        while chunk := connection.recv(1 << 16):
            received += chunk
            while len(received) >= 9 and len(received) >= 9 + int.from_bytes(received[:3]):
                end = 9 + int.from_bytes(received[:3])
                yield received[3], received[4], received[9:end]
                received = received[end:]


def test_a_silent_client_with_an_open_call_is_asked_for_a_sign_of_life(tokens):
    flags = [f"--tokens={tokens}", "--keepalive_interval=1s", "--keepalive_timeout=1s"]
    with running_server(flags=flags) as addresses:
        with open_stream(addresses.grpc) as alive:
            answered = 0
            for kind, _, payload in read_frames(alive):
                if kind == frames.PING:
                    answered += 1
                    alive.sendall(frames.frame(frames.PING, payload, frames.ACK))
                if answered == 3:
                    break
            assert answered == 3
        with open_stream(addresses.grpc) as dead:
            kinds = [kind for kind, _, _ in read_frames(dead)]
            assert kinds.count(frames.PING) == 1


def test_a_silent_client_may_stay_for_ever(tokens):
    flags = [f"--tokens={tokens}", "--keepalive_interval=1s", "--keepalive_timeout=inf"]
    with running_server(flags=flags) as addresses, open_stream(addresses.grpc) as silent:
        kinds = (kind for kind, _, _ in read_frames(silent))
        assert frames.PING in kinds
        silent.sendall(frames.frame(frames.PING, bytes(8)))
        assert frames.PING in kinds  # the answer


def test_an_old_connection_is_asked_to_go(tokens):
    with (
        running_server(flags=[f"--tokens={tokens}", "--max_connection_age=1s"]) as addresses,
        open_stream(addresses.grpc) as old,
    ):
        old.settimeout(10)  # before the keepalive ends it
        assert frames.GOAWAY in (kind for kind, _, _ in read_frames(old))


def connect(address, sent):
    host, _, port = address.rpartition(":")
    connection = socket.create_connection((host, int(port)), timeout=30)
    connection.sendall(sent)
    return connection


def test_a_connection_without_a_call_ends():
    with (
        running_server(flags=["--first_request_timeout=1s"]) as addresses,
        connect(addresses.grpc, frames.PREFACE + frames.settings()) as silent,
    ):
        assert [kind for kind, _, _ in read_frames(silent)][-1] == frames.GOAWAY


def test_a_handshake_that_does_not_end_is_given_up(certificates):
    flags = tls_flags(certificates, "--first_request_timeout=1s")
    with running_server(flags=flags) as addresses, connect(addresses.grpc, b"\x16") as silent:
        assert silent.recv(1) == b""


@pytest.mark.parametrize(("piece", "pause"), [(1, 0.05), (1 << 16, 0)])
def test_a_client_that_has_ended_its_connection_is_read_a_second_or_a_megabyte(server, piece, pause):
    end = frames.frame(frames.GOAWAY, bytes(8))
    with connect(server.grpc, frames.PREFACE + frames.settings() + end) as ended:
        assert list(read_frames(ended))
        start, sent = time.monotonic(), 0
        with pytest.raises(ConnectionError):
            while sent < 1 << 26 and time.monotonic() < start + 20:
                sent += ended.send(bytes(piece))
                time.sleep(pause)
        assert pause == 0 or time.monotonic() > start + 0.5


PREFIX = "fd00:5:1:4::"


def in_a_network_of_its_own():
    """Runs in a network namespace whose loopback has 60 addresses of a /64."""
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    sources = [f"{PREFIX}{i:x}" for i in range(1, 61)]
    lines = "".join(f"address add {source}/128 dev lo nodad\n" for source in sources)
    subprocess.run(["ip", "-batch", "-"], input=lines, text=True, check=True)
    tokens = os.environ["TOKENS"]
    flags = [
        f"--tokens={tokens}",
        "--listen=[::1]:0",
        "--insecure_network",
        "--max_connections_per_address=20",
    ]
    with running_server(flags=flags) as addresses, strangers(addresses.grpc, sources) as crowd:
        until(lambda: sum(stranger.is_open() for stranger in crowd) <= 20)
        with service_with(addresses, "agent") as agent:
            assert code_of(agent.ListPolicies) == grpc.StatusCode.OK


def test_a_64_counts_as_one_address(tokens):
    command = ["unshare", "--user", "--map-root-user", "--net", sys.executable, __file__]
    able = subprocess.run([*command[:4], "true"], check=False, capture_output=True)
    if able.returncode != 0:
        pytest.skip("the system gives no network namespaces to this user")
    subprocess.run(command, check=True, env={**os.environ, "TOKENS": str(tokens), "PYTHONPATH": os.pathsep.join(sys.path)}, timeout=120)


if __name__ == "__main__":
    in_a_network_of_its_own()
