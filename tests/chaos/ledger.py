"""Compares the ledger with the answers, while three replicas are killed, stopped and restarted.

usage: python -m tests.chaos.ledger [--sessions=N] [--decisions=N] [--rate=N] [--period=SECONDS] [--pause=SECONDS] [--seed=N]

Sessions of all kinds of clients play until each has made its decisions; what is left of the replicas then has sessions
that nobody closes, and is killed, too. Exits with status 1 unless the rows have as many decisions, spikes and joules as
the answers, to the last one. Of an ASYNC session whose server is killed before the store has its last answers, and which
is closed at another one, the rows may lack these. Needs the variable SPIKESERVE_PROGRAM.
"""

import argparse
import asyncio
import collections
import math
import os
import pathlib
import random
import sys
import time

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python")]

import spikeserve  # noqa: E402
from replicated import observation, options_of, policy_of, running_fleet  # noqa: E402

from tests.chaos.faults import Chaos  # noqa: E402
from tests.chaos.stores import Store  # noqa: E402
from tests.chaos.workload import Workload  # noqa: E402

FAULTS = ("kill", "stop", "rolling restart")
LEFT_OPEN = 4  # sessions
WAIT_SECONDS = 60.0


class CountedWorkload(Workload):
    """Keeps the answers of each session."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.said = collections.defaultdict(list)  # by number of the session
        self.numbers = {}  # by id
        self.closed = {}  # by number: time.monotonic()

    def _count(self, i, digest, decision, begin, address):
        super()._count(i, digest, decision, begin, address)
        self.said[i].append(decision)

    async def _finish(self, session, i, digest):
        self.numbers[session.session_id] = i
        await super()._finish(session, i, digest)
        self.closed[i] = time.monotonic()

    async def leave_open(self, servers):
        """Plays sessions that are not closed."""
        async with spikeserve.AsyncClient(servers) as client:
            for i in range(LEFT_OPEN):
                session = await client.open_session(policy_of(i), options_of(i, "SYNC"))
                number = f"left open {i}"
                self.numbers[session.session_id] = number
                for t in range(i + 3):
                    self.said[number].append(await session.act(observation(i, t), 0.0))

    def fewest(self, number, faults):
        """Returns how many decisions of a session must be in the ledger."""
        said = self.said[number]
        if number not in self.closed or self._options(number).durability != "ASYNC":
            return len(said)
        stored = said[-1].durable_decision
        lost = self.answers[number][stored:]  # if a server is killed that has answered them
        if any(
            fault.kind == "kill" and fault.end >= answer.at and fault.begin <= self.closed[number]
            for fault in faults
            for answer in lost
            if answer.server in fault.victims
        ):
            return stored
        return len(said)


def sums_of(decisions):
    """Returns the numbers of decisions and spikes, and joules."""
    stats = [decision.stats for decision in decisions]
    spikes = sum(sum(each.spikes_by_stage.values()) for each in stats)
    return len(stats), spikes, math.fsum(each.energy_joules for each in stats)


def booked(replica):
    """Returns the usage of this month, of all sessions, as sums_of()."""
    usage = replica.server.admin.GetUsage().rows[0].usage
    return usage.decisions, usage.spikes, usage.joules["horowitz_45nm"]


def booked_of_sessions(redis):
    """Returns what is booked of each session, by its id."""
    fields = redis.command("HGETALL us:{u}:s")
    return {
        key.decode(): (int(float(decisions)), int(float(spikes)), float(joules))
        for key, (_, decisions, spikes, joules) in zip(fields[::2], map(bytes.split, fields[1::2]), strict=True)
    }


async def play(arguments, fleet, workload):
    store = Store([fleet.redis])
    times = arguments.period, arguments.pause
    hosts = [None] * len(fleet.replicas)
    chaos = Chaos(store, fleet.replicas, hosts, FAULTS, *times, random.Random(arguments.seed))
    making = asyncio.create_task(chaos.run())
    await workload.play(fleet.addresses)
    chaos.stop()
    await making
    await workload.leave_open(fleet.addresses)
    return chaos.made


def differences(sums, sums_by_session, workload, faults):
    """Yields what differs between the rows and the answers."""
    expected = []
    for session, number in workload.numbers.items():
        said = workload.said[number]
        found = sums_by_session.get(session, (0, 0, 0.0))
        expected.append(sums_of(said[: found[0]]))
        fewest = workload.fewest(number, faults)
        if not fewest <= found[0] <= len(said) or not is_same(found, expected[-1]):
            yield f"session {number}: {fewest} to {sums_of(said)} were answered, {found} are booked"
    total = tuple(map(math.fsum, zip(*expected, strict=True)))
    if not is_same(sums, total):
        yield f"the rows have {sums}, their sessions {total}"


def is_same(some, others):
    return some[:2] == others[:2] and math.isclose(some[2], others[2], rel_tol=1e-6)


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
        answered = sums_of(decision for said in workload.said.values() for decision in said)
        print(f"{len(made)} faults; answers: {answered}")
        give_up = time.monotonic() + WAIT_SECONDS
        errors = [""]
        while errors and time.monotonic() < give_up:
            time.sleep(0.5)
            sums = booked(fleet.replicas[0])
            errors = list(differences(sums, booked_of_sessions(fleet.redis), workload, made))
    print(f"ledger: {sums}; {answered[0] - sums[0]} decisions of ASYNC sessions were lost with their servers")
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
