"""What strangers send to the status page: many ranges, names of other sites, requests that do not end."""

import contextlib
import socket
import threading
import time

import pytest
from serving import http_call

from tests.attacks.process import MEGABYTE, Process

RANGES = 2600


def get(server, path, **headers):
    return http_call(server.http, "GET", path, **headers)[::2]


def test_ranges_are_ignored(server):
    status, whole = get(server, "/vendor/uplot/uPlot.iife.min.js")
    assert status == 200
    process = Process(server.process.pid)
    idle = process.memory()
    process.reset_peak()
    ranges = "bytes=" + ",".join(["0-"] * RANGES)
    assert get(server, "/vendor/uplot/uPlot.iife.min.js", Range=ranges) == (200, whole)
    assert get(server, "/vendor/uplot/uPlot.iife.min.js", Range="bytes=0-9") == (200, whole)
    assert process.peak() - idle < 5 * MEGABYTE


OWN_NAMES = ["localhost", "localhost:1", "127.0.0.1", "127.0.0.1:9", "[::1]:80"]
OTHER_NAMES = ["evil.example", "evil.example:9464", "localhost.evil.example", "10.0.0.1"]


@pytest.mark.parametrize("host", OWN_NAMES)
def test_names_of_this_machine_are_served(server, host):
    assert get(server, "/healthz", Host=host)[0] == 200


@pytest.mark.parametrize("host", OTHER_NAMES)
def test_names_of_other_sites_are_refused(server, host):
    for path in ("/", "/healthz", "/status.json"):
        status, body = get(server, path, Host=host)
        assert status == 403
        assert body == b"Host: expected localhost or a loopback address\n"


# More connections than the server keeps open.
SLOW_CONNECTIONS = 400
BYTE_SECONDS = 0.05  # between two bytes of a slow connection
HEALTH_CHECKS = 50


class SlowClient:
    """Holds connections, and sends a header byte by byte on each; opens those anew that were closed."""

    def __init__(self, address, connections):
        host, _, port = address.rpartition(":")
        self._address = (host, int(port))
        self._sockets = [self._connect() for _ in range(connections)]
        self.closed = 0  # connections that the server closed
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._send)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopped.set()
        self._thread.join()
        for slow in self._sockets:
            slow.close()

    def _connect(self):
        slow = socket.create_connection(self._address)
        slow.sendall(b"GET /healthz HTTP/1.1\r\nX-Slow: ")
        return slow

    def _send(self):
        while not self._stopped.wait(BYTE_SECONDS):
            for i, slow in enumerate(self._sockets):
                try:
                    slow.sendall(b"x")
                except OSError:
                    self.closed += 1
                    slow.close()
                    self._sockets[i] = self._connect()


def test_slow_requests_do_not_delay_others(server):
    with SlowClient(server.http, SLOW_CONNECTIONS) as slow:
        seconds = []
        # Until the server has closed every connection once, for its age or for newer ones.
        while slow.closed < SLOW_CONNECTIONS or len(seconds) < HEALTH_CHECKS:
            start = time.perf_counter()
            assert get(server, "/healthz")[0] == 200
            seconds.append(time.perf_counter() - start)
        print(f"/healthz: at most {1000 * max(seconds):.1f} ms in {len(seconds)} requests")


def test_a_request_has_to_end_in_time(server):
    host, _, port = server.http.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=60) as slow:
        slow.sendall(b"GET /healthz HTTP/1.1\r\n")
        assert slow.recv(1) == b""


def exchange(server, *pieces):
    """Sends bytes, as far as the server takes them, and returns the first line of its answer."""
    host, _, port = server.http.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=60) as connection:
        with contextlib.suppress(OSError):
            for piece in pieces:
                connection.sendall(piece)
        return connection.makefile("rb").readline()


def test_long_headers_are_not_stored(server):
    process = Process(server.process.pid)
    idle = process.memory()
    process.reset_peak()
    header = [b"GET / HTTP/1.1\r\nX: ", b"a" * 20_000]
    assert exchange(server, *header) == b"HTTP/1.1 431 Request Header Fields Too Large\r\n"
    with contextlib.suppress(ConnectionError):
        exchange(server, b"GET / HTTP/1.1\r\nX: ", *([b"a" * MEGABYTE] * 64))
    assert process.peak() - idle < 5 * MEGABYTE
    assert get(server, "/healthz")[0] == 200


@pytest.mark.parametrize(
    ("request_line", "answer"),
    [
        (b"POST /healthz HTTP/1.1", b"HTTP/1.1 405 Method Not Allowed\r\n"),
        (b"GET healthz HTTP/1.1", b"HTTP/1.1 400 Bad Request\r\n"),
        (b"GET /%4x HTTP/1.1", b"HTTP/1.1 400 Bad Request\r\n"),
        (b"GET /%68ealthz HTTP/1.1", b"HTTP/1.1 200 OK\r\n"),
        (b"HEAD /healthz HTTP/1.0", b"HTTP/1.1 200 OK\r\n"),
        (
            b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nHost: localhost",
            b"HTTP/1.1 400 Bad Request\r\n",
        ),
        (b"PRI * HTTP/2.0", b"HTTP/1.1 400 Bad Request\r\n"),
        (b"\x16\x03\x01", b"HTTP/1.1 400 Bad Request\r\n"),
    ],
)
def test_request_lines(server, request_line, answer):
    assert exchange(server, request_line, b"\r\n\r\n") == answer
