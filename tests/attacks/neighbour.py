"""An agent of another tenant, in a process of its own: plays without pause, and prints its latencies.

Each line that it reads from stdin ends a period. It answers with one line of JSON: the quantiles of the period's
latencies in seconds, and how many calls failed.

usage: python3 -m tests.attacks.neighbour HOST:PORT [CA_FILE]
"""

import json
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


class Player:
    """Calls Act until it is told to stop."""

    def __init__(self, channel):
        opened = call(channel, f"/{POLICY}/OpenSession")(
            v1("OpenSessionRequest", policy="cartpole"), metadata=TOKEN, timeout=CALL_SECONDS
        )
        self._session = opened.session_id
        self._act = call(channel, f"/{POLICY}/Act")
        self._step = 0
        self._lock = threading.Lock()
        self._latencies, self._failed = [], 0

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
        with self._lock:
            self._latencies.append(time.perf_counter() - start)
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


def main():
    """Plays until stdin ends."""
    address, *ca_file = sys.argv[1:]
    if ca_file:
        with open(ca_file[0], "rb") as ca:
            channel = grpc.secure_channel(address, grpc.ssl_channel_credentials(ca.read()))
    else:
        channel = grpc.insecure_channel(address)
    player = Player(channel)
    stopped = threading.Event()

    def play():
        while not stopped.is_set():
            player.play()
            stopped.wait(PERIOD_SECONDS)

    thread = threading.Thread(target=play)
    thread.start()
    print("ready", flush=True)
    for _ in sys.stdin:
        print(json.dumps(player.period()), flush=True)
    stopped.set()
    thread.join()


if __name__ == "__main__":
    main()
