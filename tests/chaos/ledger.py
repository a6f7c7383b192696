"""Compares the ledger with the answers, while three replicas are killed, stopped and restarted.

usage: python -m tests.chaos.ledger [--sessions=N] [--decisions=N] [--rate=N] [--period=SECONDS] [--pause=SECONDS] [--seed=N]

Sessions of all kinds of clients play until each has made its decisions; what is left of the replicas then has sessions
that nobody closes, and is killed, too. Exits with status 1 unless the rows have as many decisions, spikes and joules as
the answers, to the last one. Needs the variable SPIKESERVE_PROGRAM.
"""

import argparse
import asyncio
import math
import os
import pathlib
import random
import sys
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

import grpc  # noqa: E402
import spikeserve  # noqa: E402
from replicated import observation, options_of, policy_of, running_fleet  # noqa: E402
from serving import ADMIN, Service  # noqa: E402

from tests.chaos.faults import Chaos  # noqa: E402
from tests.chaos.stores import Store  # noqa: E402
from tests.chaos.workload import Workload  # noqa: E402

FAULTS = ("kill", "stop", "rolling restart")
LEFT_OPEN = 4  # sessions
WAIT_SECONDS = 60.0


class CountedWorkload(Workload):
    """Sums up what the answers say."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.spikes = 0
        self.joules = 0.0

    def _count(self, i, digest, decision, begin, address):
        super()._count(i, digest, decision, begin, address)
        self.add(decision)

    def add(self, decision):
        self.spikes += sum(decision.stats.spikes_by_stage.values())
        self.joules += decision.stats.energy_joules


def booked(replica):
    """Returns the usage of this month, of all sessions."""
    with grpc.insecure_channel(replica.address) as channel:
        [row] = Service(channel, ADMIN).GetUsage().rows or [None]
    return row.usage


async def leave_open(servers, workload):
    """Plays sessions that are not closed."""
    async with spikeserve.AsyncClient(servers) as client:
        for i in range(LEFT_OPEN):
            session = await client.open_session(policy_of(i), options_of(i, "SYNC"))
            for t in range(i + 3):
                decision = await session.act(observation(i, t), 0.0)
                workload.decided += 1
                workload.add(decision)


async def play(arguments, fleet, workload):
    store = Store([fleet.redis])
    times = arguments.period, arguments.pause
    hosts = [None] * len(fleet.replicas)
    chaos = Chaos(store, fleet.replicas, hosts, FAULTS, *times, random.Random(arguments.seed))
    making = asyncio.create_task(chaos.run())
    await workload.play(fleet.addresses)
    chaos.stop()
    await making
    await leave_open(fleet.addresses, workload)
    return chaos.made


def compare(arguments):
    """Returns what is wrong."""
    workload = CountedWorkload(arguments.sessions, arguments.decisions, True, arguments.rate, timeout=1.0)
    workload.group = max(1, arguments.sessions // 5)  # so that there are all kinds of clients
    with running_fleet("--usage_interval=200ms", "--session_ttl=24h") as fleet:
        made = asyncio.run(play(arguments, fleet, workload))
        for replica in fleet.replicas:
            replica.kill()
        for replica in fleet.replicas:
            replica.start()
        give_up = time.monotonic() + WAIT_SECONDS
        usage = booked(fleet.replicas[0])
        while usage.decisions < workload.decided and time.monotonic() < give_up:
            time.sleep(0.1)
            usage = booked(fleet.replicas[0])
        joules = usage.joules["horowitz_45nm"]
    print(f"{len(made)} faults; answers: {workload.decided} decisions, {workload.spikes} spikes, {workload.joules:.9g} J")
    print(f"ledger: {usage.decisions} decisions, {usage.spikes} spikes, {joules:.9g} J, {usage.sessions} sessions")
    errors = []
    if (usage.decisions, usage.spikes) != (workload.decided, workload.spikes):
        errors.append("the ledger has other sums than the answers")
    if not math.isclose(joules, workload.joules, rel_tol=1e-6):
        errors.append("the ledger has other joules than the answers")
    missing = set(FAULTS) - {fault.kind for fault in made}
    return errors + [f"not made: {kind}" for kind in sorted(missing)]


def main():
    parser = argparse.ArgumentParser(prog="tests.chaos.ledger")
    parser.add_argument("--sessions", type=int, default=250)
    parser.add_argument("--decisions", type=int, default=400, help="of each session")
    parser.add_argument("--rate", type=float, default=20.0, help="decisions a second of a session, at most")
    parser.add_argument("--period", type=float, default=2.0, help="seconds between faults")
    parser.add_argument("--pause", type=float, default=7.0, help="seconds that a replica is stopped")
    parser.add_argument("--seed", type=int, default=1)
    errors = compare(parser.parse_args())
    print(*errors, sep="\n", flush=True)
    return 1 if errors else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
