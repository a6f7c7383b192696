"""An agent of another tenant, in a process of its own: plays without pause, and tells its latencies.

A probe of the health page runs beside it. What the process receives is the name of what begins now, which may come again.
In the end it sends, for each name, the quantiles of the latencies in seconds and how many calls failed, and "health"
with those of the page. The address is HOST:PORT, or ws://HOST:PORT of a gateway.
"""

import collections
import http.client
import pathlib
import ssl
import statistics
import threading
import time

import grpc
from contract import call, v1
from security import OBSERVATION, POLICY

from tests.attacks.websocket import Robot

TOKEN = (("authorization", "Bearer rival"),)
CALL_SECONDS = 5
PERIOD_SECONDS = 0.002  # between two calls
PROBE_SECONDS = 0.02  # between two requests for the health page


class Latencies:
    """What calls took, by the period in which they ended. One thread adds; another sets `period`."""

    def __init__(self):
        self.period = ""
        self._latencies = collections.defaultdict(list)
        self._failed = collections.Counter()

    def add(self, seconds, failed):
        """Counts one call."""
        period = self.period
        self._latencies[period].append(seconds)
        self._failed[period] += failed

    def figures(self, period):
        """Returns the quantiles of a period."""
        latencies = self._latencies[period]
        quantiles = statistics.quantiles(latencies, n=100) if len(latencies) > 1 else [None] * 99
        return {
            "calls": len(latencies),
            "failed": self._failed[period],
            "p50": quantiles[49],
            "p99": quantiles[98],
        }


class Probe:
    """Asks for the health page, each time on a new connection."""

    def __init__(self, address, tls):
        self._address = address
        self._tls = ssl._create_unverified_context() if tls else None
        self.latencies = Latencies()

    def ask(self):
        """Makes one request."""
        start, failed = time.perf_counter(), 1
        try:
            if self._tls is None:
                page = http.client.HTTPConnection(self._address, timeout=CALL_SECONDS)
            else:
                page = http.client.HTTPSConnection(self._address, timeout=CALL_SECONDS, context=self._tls)
            page.request("GET", "/healthz")
            failed = int(page.getresponse().status != 200)
            page.close()
        except OSError:
            pass
        self.latencies.add(time.perf_counter() - start, failed)


class Player:
    """An agent, or with ws:// as its address the robot of a gateway, which may play on after each of its calls."""

    def __init__(self, address, ca_file):
        self.latencies = Latencies()
        if address.startswith("ws://"):
            host, _, port = address.removeprefix("ws://").rpartition(":")
            robot = Robot((host, int(port)), "Authorization: Api-Key rival", seconds=CALL_SECONDS)
            self._call = robot.call
            return
        if ca_file is None:
            channel = grpc.insecure_channel(address)
        else:
            channel = grpc.secure_channel(address, grpc.ssl_channel_credentials(pathlib.Path(ca_file).read_bytes()))
        opened = call(channel, f"/{POLICY}/OpenSession")(
            v1("OpenSessionRequest", policy="cartpole"), metadata=TOKEN, timeout=CALL_SECONDS
        )
        self._session = opened.session_id
        self._act = call(channel, f"/{POLICY}/Act")
        self._step = 0
        self._call = self._decide

    def _decide(self):
        request = v1(
            "ActRequest", session_id=self._session, step=self._step, observation=OBSERVATION
        )
        self._act(request, metadata=TOKEN, timeout=CALL_SECONDS)
        self._step += 1

    def play(self):
        """Makes one call."""
        start, failed = time.perf_counter(), 0
        try:
            self._call()
        except (grpc.RpcError, OSError):
            failed = 1
        self.latencies.add(time.perf_counter() - start, failed)


def play(connection, address, http_address, ca_file=None):
    """Plays until `connection`, of multiprocessing, has sent the names of all periods and None."""
    player = Player(address, ca_file)
    probe = Probe(http_address, ca_file is not None)
    stopped = threading.Event()

    def repeat(work, pause):
        while not stopped.is_set():
            work()
            stopped.wait(pause)

    threads = [
        threading.Thread(target=repeat, args=(player.play, PERIOD_SECONDS)),
        threading.Thread(target=repeat, args=(probe.ask, PROBE_SECONDS)),
    ]
    for thread in threads:
        thread.start()
    connection.send("ready")
    names = []
    for name in iter(connection.recv, None):
        names.append(name)
        player.latencies.period = probe.latencies.period = name
    stopped.set()
    for thread in threads:
        thread.join()
    connection.send(
        {name: player.latencies.figures(name) | {"health": probe.latencies.figures(name)} for name in names}
    )
