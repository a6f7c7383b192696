"""Flies pilots of both languages while servers, stores, links and the robots themselves fail.

usage: python -m tests.chaos.pilots [--pilots=N] [--faults=N] [--servers=N] [--store=file|redis] [--durability=LEVEL]
  [--kinds=KIND,...] [--beat=SECONDS] [--period=SECONDS] [--pause=SECONDS] [--seed=N]

Half of the pilots are those of the Python client, half those of the C++ client, each in a process of its own. Checks that
no session is lost, that each episode has every reward once, and that each session equals, bit for bit, one on an
undisturbed server that was told the same steps. Needs the variables SPIKESERVE_PROGRAM and CLIENT_PILOT_PROGRAM.
"""

import argparse
import collections
import concurrent.futures
import contextlib
import itertools
import os
import pathlib
import random
import signal
import sys
import tempfile
import threading
import time
from types import SimpleNamespace

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "python"), str(ROOT / "tests" / "python" / "pilot")]

import spikeserve  # noqa: E402
from links import Link  # noqa: E402
from replicated import options_of, policy_of, running_fleet  # noqa: E402
from restartable_server import RestartableServer  # noqa: E402
from spikeserve.wire import METHODS  # noqa: E402
from test_cpp_pilot import CppFlight  # noqa: E402
from test_pilot import SIZES, Flight, undisturbed  # noqa: E402

ALONE = ("kill", "stop", "restart", "cut", "sleep", "stop robots", "another robot")
KINDS = {"file": ALONE, "redis": (*ALONE, "lose the tail")}
EPISODE = 40  # beats, about


def parse_arguments():
    parser = argparse.ArgumentParser(prog="tests.chaos.pilots")
    parser.add_argument("--pilots", type=int, default=64)
    parser.add_argument("--faults", type=int, default=1000)
    parser.add_argument("--servers", type=int, default=1, help="more than one share a Redis")
    parser.add_argument("--store", choices=KINDS, default="redis")
    parser.add_argument("--durability", choices=("ASYNC", "SYNC"), default="ASYNC")
    parser.add_argument("--kinds", help="of faults, separated by commas; all by default")
    parser.add_argument("--beat", type=float, default=0.2, help="seconds, the period of the pilots")
    parser.add_argument("--period", type=float, default=0.5, help="seconds between faults")
    parser.add_argument("--pause", type=float, default=1.0, help="seconds that a server or a robot is away")
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    arguments = parser.parse_args()
    kinds = [kind for kind in KINDS[arguments.store] if arguments.servers == 1 or kind != "another robot"]
    arguments.kinds = arguments.kinds.split(",") if arguments.kinds else kinds
    return arguments


@contextlib.contextmanager
def running_servers(arguments):
    """Yields Redis, or None, and the servers."""
    if arguments.store == "redis":
        with running_fleet(replicas=arguments.servers) as fleet:
            yield fleet.redis, fleet.replicas
        return
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        server = RestartableServer(f"--session_store=file:{folder}")
        stack.callback(server.kill)
        server.start()
        yield None, [server]


class Faults:
    """Makes faults, one after the other, and counts them by kind."""

    def __init__(self, arguments, redis, servers, links, flights, client):
        self._arguments, self._random = arguments, random.Random(arguments.seed)
        self._redis, self._servers, self._links = redis, servers, links
        self._flights, self._client = flights, client
        self.made = collections.Counter()
        self.told = 0  # other robots

    def run(self):
        for kind in itertools.islice(itertools.cycle(self._arguments.kinds), self._arguments.faults):
            time.sleep(self._arguments.period)
            getattr(self, "_" + kind.replace(" ", "_"))(self._random.choice(self._servers))
            self.made[kind] += 1

    def _wait(self):
        time.sleep(self._random.uniform(0, self._arguments.pause))

    def _kill(self, server):
        server.kill()
        server.start()

    def _stop(self, server):
        server.stop()
        self._wait()
        server.resume()

    def _restart(self, server):
        server.restart()

    def _cut(self, server):
        link = self._links[self._servers.index(server)]
        link.cut()
        self._wait()
        link.heal()  # what waited arrives, also at a server that has lost its sessions to another one

    def _lose_the_tail(self, _):
        self._redis.process.send_signal(signal.SIGSTOP)
        self._wait()
        for server in self._servers:
            server.kill()
        self._redis.kill()  # with what has arrived since it stopped
        self._redis.start()
        for server in self._servers:
            server.start()

    def _sleep(self, _):
        """Lets the clock of a robot jump that counts its sleep; all pilots in Python have the same one."""
        robots = [flight for i, flight in enumerate(self._flights) if i == 0 or isinstance(flight, CppFlight)]
        self._random.choice(robots).suspend(self._random.uniform(1, 15))

    def _stop_robots(self, _):
        processes = [flight.pilot.process for flight in self._flights if isinstance(flight, CppFlight)]
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        self._wait()
        for process in processes:
            process.send_signal(signal.SIGCONT)

    def _another_robot(self, _):
        """A second robot has the id of a session by mistake, and sends a step that the first one has sent.

        With several servers, one that had the session before may tell of steps that are lost.
        """
        flight = self._random.choice(self._flights)
        try:
            session = METHODS["GetSession"].request(session_id=flight.pilot.session_id)
            state = self._client.call("GetSession", session)
            place = {"step": state.step - 1, "decision": state.decisions - 1} if state.step > 0 else {"step": -1}
            observation = [9.0] * SIZES[flight.policy]
            request = METHODS["Act"].request(session_id=state.session_id, observation=observation, **place)
            self._client.call("Act", request)
        except spikeserve.FailedPreconditionError as error:
            self.told += "another robot" in error.message  # or the first one has gone on
        else:
            raise AssertionError(f"session {state.session_id}: another robot was answered")


def fly(flight, is_over, rng):
    """Flies until the faults are over, and once more to the end of an episode."""
    while not is_over.is_set():
        flight.fly(rng.randint(1, EPISODE))
        flight.end()
    flight.until("fresh")
    flight.end()


def play(arguments, redis, servers):
    """Returns the faults, the flights, and what is wrong."""
    with contextlib.ExitStack() as stack:
        links = [stack.enter_context(Link(server.address)) for server in servers]
        addresses = ",".join(link.address for link in links)
        client = stack.enter_context(spikeserve.Client(addresses))
        direct = stack.enter_context(spikeserve.Client(",".join(server.address for server in servers)))
        flights = []
        for i in range(arguments.pilots):
            options = SimpleNamespace(local=False, session=options_of(i, arguments.durability), max_age=5.0)
            flight = [Flight, CppFlight][i % 2](client, policy_of(i), arguments.beat, **vars(options))
            flights.append(stack.enter_context(flight))
        faults, is_over = Faults(arguments, redis, servers, links, flights, direct), threading.Event()
        with concurrent.futures.ThreadPoolExecutor(len(flights)) as threads:
            flying = [threads.submit(fly, flight, is_over, random.Random(i)) for i, flight in enumerate(flights)]
            try:
                faults.run()
            finally:
                is_over.set()
        ends = enumerate(done.exception() for done in flying)
        errors = [f"pilot {i}: {end!r}, {flights[i].pilot.stats()}" for i, end in ends if end is not None]
        other = stack.enter_context(undisturbed())
        for i, flight in enumerate(flights):
            stats = flight.pilot.stats()
            if stats.reopened or stats.lost_episodes:
                errors.append(f"pilot {i}: expected no session and no episode lost, received {stats}")
            try:
                flight.check_equal(direct, other)
            except Exception as error:
                errors.append(f"pilot {i}: {error!r}"[:300])
        return faults, flights, errors


def main():
    arguments = parse_arguments()
    with running_servers(arguments) as (redis, servers):
        faults, flights, errors = play(arguments, redis, servers)
    beats = sum(len(flight.actions) for flight in flights)
    fresh = sum(action.source == "fresh" for flight in flights for action in flight.actions)
    episodes = sum(len(flight.summaries) for flight in flights)
    print(f"{dict(faults.made)}; {faults.told} other robots were told so")
    print(f"{len(flights)} pilots, {episodes} episodes, {beats} beats, {fresh} fresh, {len(errors)} errors")
    print(*errors, sep="\n", flush=True)
    return 1 if errors else 0


if __name__ == "__main__":
    os.chdir(ROOT)
    sys.exit(main())
