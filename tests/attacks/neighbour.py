"""An agent of another tenant, in a process of its own: plays without pause, and prints its latencies.

A probe of the health page runs beside it. Each line that it reads from stdin ends a period. It answers with one line of
JSON: the quantiles of the period's latencies in seconds and how many calls failed, and "health" with those of the page.

usage: python3 -m tests.attacks.neighbour HOST:PORT HTTP_HOST:PORT [CA_FILE]
"""

import http.client
import json
import ssl
import statistics
import sys
import threading
import time

import grpc
from contract import call, v1
from security import OBSERVATION, POLICY

TOKEN = (("authorization", "Bearer rival"),)
CALL_SECONDS = 5
PERIOD_SECONDS = 0.002  # between two calls
PROBE_SECONDS = 0.02  # between two requests for the health page


class Latencies:
    """What calls took since the last period. Safe for two threads."""

    def __init__(self):
        self._lock = threading.Lock()
        self._latencies, self._failed = [], 0

    def add(self, seconds, failed):
        """Counts one call."""
        with self._lock:
            self._latencies.append(seconds)
            self._failed += failed

    def period(self):
        """Returns the figures since the last call of this method."""
        with self._lock:
            latencies, self._latencies = self._latencies, []
            failed, self._failed = self._failed, 0
        if len(latencies) < 2:
            return {"calls": len(latencies), "failed": failed, "p50": None, "p99": None}
        quantiles = statistics.quantiles(latencies, n=100)
        return {
            "calls": len(latencies),
            "failed": failed,
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
    """Calls Act until it is told to stop."""

    def __init__(self, channel):
        opened = call(channel, f"/{POLICY}/OpenSession")(
            v1("OpenSessionRequest", policy="cartpole"), metadata=TOKEN, timeout=CALL_SECONDS
        )
        self._session = opened.session_id
        self._act = call(channel, f"/{POLICY}/Act")
        self._step = 0
        self.latencies = Latencies()

    def play(self):
        """Makes one call."""
        request = v1(
            "ActRequest", session_id=self._session, step=self._step, observation=OBSERVATION
        )
        start = time.perf_counter()
        try:
            self._act(request, metadata=TOKEN, timeout=CALL_SECONDS)
            self._step += 1
            failed = 0
        except grpc.RpcError:
            failed = 1
        self.latencies.add(time.perf_counter() - start, failed)


def main():
    """Plays until stdin ends."""
    address, http_address, *ca_file = sys.argv[1:]
    if ca_file:
        with open(ca_file[0], "rb") as ca:
            channel = grpc.secure_channel(address, grpc.ssl_channel_credentials(ca.read()))
    else:
        channel = grpc.insecure_channel(address)
    player = Player(channel)
    probe = Probe(http_address, bool(ca_file))
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
    print("ready", flush=True)
    for _ in sys.stdin:
        print(json.dumps(player.latencies.period() | {"health": probe.latencies.period()}), flush=True)
    stopped.set()
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    main()
