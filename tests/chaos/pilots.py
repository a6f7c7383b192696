"""Flies pilots of both languages while servers, stores, links, clocks and the robots themselves fail.

usage: python -m tests.chaos.pilots [--pilots=N] [--faults=N] [--servers=N,...] [--store=file,redis]
  [--durability=LEVEL,...] [--transports=stream,datagram] [--kinds=KIND,...] [--beat=SECONDS] [--period=SECONDS]
  [--pause=SECONDS] [--seed=N]

Plays a round for each set-up: every number of servers with every store and durability that go together, on each of which
all pilots fly and an equal part of the faults is made. Half of the pilots are those of the Python client, half those of
the C++ client, each in a process of its own; half of each send their steps as datagrams where these come through, which
are lost, doubled and reordered. Checks that no session is lost, that each episode has every reward once, that
every action that was called fresh is an answer, and that each session equals, bit for bit, one on an undisturbed server
that was told the same steps. Needs the variables SPIKESERVE_PROGRAM and CLIENT_PILOT_PROGRAM, and root for a disk of its
own. Exits with status 1 if something differs, and with 77 if it may not mount.
"""

import argparse
import concurrent.futures
import contextlib
import itertools
import os
import pathlib
import random
import sys
import tempfile
import threading
from types import SimpleNamespace

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python"), str(ROOT / "tests" / "python" / "pilot")]

import spikeserve  # noqa: E402
import test_pilot  # noqa: E402
from datagram_relay import DatagramRelay  # noqa: E402
from links import Link  # noqa: E402
from machine import Clock, small_disk  # noqa: E402
from replicated import claim, options_of, policy_of, running_fleet  # noqa: E402
from restartable_server import RestartableServer  # noqa: E402
from test_cpp_pilot import CppFlight  # noqa: E402
from test_pilot import Flight, undisturbed  # noqa: E402

from tests.chaos.pilot_faults import Faults, kinds_of  # noqa: E402

SKIPPED = 77
EPISODE = 40  # beats, about
DISK = 64 << 20  # bytes
PATIENCE = 300.0  # seconds, on a busy machine
TTL = "--session_ttl=24h"  # the comparison of many sessions takes a while, too
DATAGRAMS = {"loss": 0.02, "doubled": 0.1, "reordered": 0.1}  # shares
PATIENT = spikeserve.ClientOptions(connect_timeout=PATIENCE, retry=spikeserve.RetryOptions(max_elapsed=PATIENCE))


def parse_arguments():
    parser = argparse.ArgumentParser(prog="tests.chaos.pilots")
    parser.add_argument("--pilots", type=int, default=64)
    parser.add_argument("--faults", type=int, default=1000, help="of all rounds together")
    parser.add_argument("--servers", default="1,3", help="numbers; more than one share a Redis")
    parser.add_argument("--store", default="file,redis")
    parser.add_argument("--durability", default="ASYNC,SYNC")
    parser.add_argument("--transports", type=lambda names: names.split(","), default=["stream", "datagram"])
    parser.add_argument("--kinds", help="of faults, separated by commas; all by default")
    parser.add_argument("--beat", type=float, default=0.5, help="seconds, the period of the pilots")
    parser.add_argument("--period", type=float, default=0.5, help="seconds between faults")
    parser.add_argument("--pause", type=float, default=1.0, help="seconds that a server or a robot is away")
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    arguments = parser.parse_args()
    choices = (arguments.store.split(","), map(int, arguments.servers.split(",")), arguments.durability.split(","))
    rounds = [round for round in itertools.product(*choices) if round[0] == "redis" or round[1] == 1]
    return arguments, rounds


@contextlib.contextmanager
def running(store, servers):
    """Yields the servers with the links to them, and what else faults hit; None if this process may not mount."""
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
        setup = SimpleNamespace(redis=None, disk=None, server_clock=Clock(folder / "servers"))
        setup.robot_clock = Clock(folder / "robots")
        setup.relays = [stack.enter_context(DatagramRelay(seed=i, **DATAGRAMS)) for i in range(servers)]
        if store == "redis":
            fleet = stack.enter_context(running_fleet(TTL, prefix=setup.server_clock.prefix, relays=setup.relays))
            setup.redis, setup.servers = fleet.redis, fleet.replicas
        else:
            setup.disk = stack.enter_context(small_disk(folder / "disk", DISK))
            if setup.disk is None:
                yield None
                return
            files = f"--session_store=file:{setup.disk}/store"
            server = RestartableServer(files, TTL, prefix=setup.server_clock.prefix, relay=setup.relays[0])
            stack.callback(server.kill)
            server.start()
            setup.servers = [server]
        setup.direct = [stack.enter_context(spikeserve.Client(server.address, PATIENT)) for server in setup.servers]
        setup.links = [stack.enter_context(Link(server.address)) for server in setup.servers]
        yield setup


def fly(flight, is_over, rng):
    """Flies until the faults are over, and once more to the end of an episode."""
    while not is_over.is_set():
        flight.fly(rng.randint(1, EPISODE))
        flight.end()
    flight.until("fresh")
    flight.end()


def fly_all(flights, make_faults):
    """Flies while faults are made. Returns what is wrong."""
    is_over = threading.Event()
    with concurrent.futures.ThreadPoolExecutor(len(flights)) as threads:
        flying = [threads.submit(fly, flight, is_over, random.Random(i)) for i, flight in enumerate(flights)]
        try:
            make_faults()
        finally:
            is_over.set()
    ends = enumerate(done.exception() for done in flying)
    return [f"pilot {i}: {end!r}, {flights[i].pilot.stats()}" for i, end in ends if end is not None]


def errors_of(flights, client):
    """Compares the sessions with undisturbed ones. Returns what is wrong. `client` reaches one server."""
    errors = []
    with undisturbed() as other:
        for i, flight in enumerate(flights):
            stats = flight.pilot.stats()
            if stats.reopened or stats.lost_episodes:
                errors.append(f"pilot {i}: expected no session and no episode lost, received {stats}")
            try:
                claim(client, flight.pilot.session_id)  # it may have a former copy, and no server takes over to export one
                flight.check_equal(client, other)
            except Exception as error:
                errors.append(f"pilot {i}: {error!r}"[:300])
    return errors


def play_round(arguments, store, servers, durability, count):
    """Plays one round and prints what was made. Returns what is wrong, or None if this process may not mount."""
    with running(store, servers) as setup, contextlib.ExitStack() as stack:
        if setup is None:
            return None
        client = stack.enter_context(spikeserve.Client(",".join(link.address for link in setup.links), PATIENT))
        flights = []
        for i in range(arguments.pilots):
            session, transport = options_of(i, durability), arguments.transports[i // 2 % len(arguments.transports)]
            if transport == "datagram":
                session.labels["datagrams"] = "true"  # of a session with a channel, a part of its value
            options = {"local": False, "session": session, "max_age": 5.0, "transport": transport}
            options |= {"prefix": setup.robot_clock.prefix, "patience": PATIENCE} if i % 2 else {}
            flight = [Flight, CppFlight][i % 2](client, policy_of(i), arguments.beat, **options)
            if i % 2:
                stack.callback(flight.pilot.end)
            flights.append(stack.enter_context(flight))
        faults = Faults(setup, flights, arguments.period, arguments.pause, arguments.seed)
        kinds = arguments.kinds.split(",") if arguments.kinds else kinds_of(store, servers)
        errors = fly_all(flights, lambda: faults.run(kinds, count)) + errors_of(flights, setup.direct[0])
        datagrams = sum(flight.pilot.stats().datagram_answers for flight in flights)
    beats = sum(len(flight.actions) for flight in flights)
    fresh = sum(action.source == "fresh" for flight in flights for action in flight.actions)
    episodes = sum(len(flight.summaries) for flight in flights)
    print(f"{store}, {servers} servers, {durability}: {len(flights)} pilots, {faults.made.total()} faults")
    print(f"  {dict(faults.made)}; {faults.told} other robots were told so")
    print(f"  {episodes} episodes, {beats} beats, {fresh} fresh, {datagrams} answers as datagrams, {len(errors)} errors")
    print(*errors, sep="\n", end="\n" if errors else "", flush=True)
    return errors


def main():
    test_pilot.WAIT = PATIENCE
    arguments, rounds = parse_arguments()
    share, rest = divmod(arguments.faults, len(rounds))
    outcomes = [play_round(arguments, *each, share + (i < rest)) for i, each in enumerate(rounds)]
    if any(errors is None for errors in outcomes):
        print("chaos: skipped the file store, because mounting needs root")
    if any(outcomes):
        return 1
    return SKIPPED if None in outcomes else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
