"""Measures how long the first answer takes after another replica has claimed a session from Redis.

usage: build/venv/bin/python lab/bench/store_claims.py [--claims=N]

One client sends the decisions of a session to two replicas in turn, so that each is answered by a replica that has to claim
the session first. Prints the times as the client sees them, and those of decisions at the owner. Needs the variable
SPIKESERVE_PROGRAM, and the client in PYTHONPATH.
"""

import argparse
import os
import pathlib
import sys
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests" / "python")]

import spikeserve  # noqa: E402
from replicated import observation, options_of, reward, running_fleet  # noqa: E402


def times_of(clients, decisions):
    """Returns the seconds of each decision of a new session, which go to the clients in turn."""
    seconds = []
    session_id = clients[0].open_session("cartpole", options_of(0, "SYNC")).session_id
    for t in range(decisions):
        session = spikeserve.Session(clients[t % len(clients)], session_id, step=t)
        begin = time.monotonic()
        session.act(observation(0, t), reward(t))
        seconds.append(time.monotonic() - begin)
    return sorted(seconds[len(clients) :])


def report(name, seconds):
    p50, p99 = (1000 * seconds[int(len(seconds) * part)] for part in (0.5, 0.99))
    print(f"{name:24} {len(seconds):6} {p50:7.2f} ms {p99:7.2f} ms {1000 * seconds[-1]:7.2f} ms")


def main():
    parser = argparse.ArgumentParser(prog="store_claims.py")
    parser.add_argument("--claims", type=int, default=2000)
    arguments = parser.parse_args()
    with (
        running_fleet(replicas=2) as fleet,
        spikeserve.Client(fleet.replicas[0].address) as first,
        spikeserve.Client(fleet.replicas[1].address) as second,
    ):
        print(f"{'':24} {'times':>6} {'p50':>10} {'p99':>10} {'max':>10}")
        report("at the owner", times_of([first], arguments.claims))
        report("after a claim", times_of([first, second], arguments.claims))


if __name__ == "__main__":
    os.chdir(ROOT)
    main()
