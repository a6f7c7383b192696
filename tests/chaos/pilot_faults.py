"""Faults that tests.chaos.pilots makes, one after the other, while pilots fly."""

import collections
import itertools
import random
import signal
import time

from machine import fill
from replicated import claim, refusal_of
from spikeserve.wire import METHODS
from test_cpp_pilot import CppFlight
from test_pilot import SIZES

ALONE = (
    "kill",
    "stop",
    "restart",
    "cut",
    "drop datagrams",
    "change addresses",
    "fill the store",
    "another robot",
    "sleep",
    "stop robots",
    "jump the servers' clock",
    "jump the robots' clock",
)
DAY = 86400
LATE = 3  # pauses: pilots ask another server after a second
BEHIND = 3  # steps, of which an ASYNC store may lack the last ones


def kinds_of(store, servers):
    """Returns the kinds of faults that a set-up can have."""
    return (*ALONE, *(["lose the tail"] if store == "redis" else []), *(["take over"] if servers > 1 else []))


class Faults:
    """Makes faults, one after the other, and counts them by kind.

    `setup` has the servers, the links and relays of datagrams to them, clients that reach one of them each, Redis or the disk of the file store,
    and the clocks of servers and robots.
    """

    def __init__(self, setup, flights, period, pause, seed):
        self._setup, self._flights = setup, flights
        self._period, self._pause, self._random = period, pause, random.Random(seed)
        self.made = collections.Counter()
        self.told = 0  # other robots

    def run(self, kinds, count):
        """Makes `count` faults of `kinds` in turn, `period` seconds apart.

        What is away comes back within `pause` seconds, and a link within LATE times as many.
        """
        for kind in itertools.islice(itertools.cycle(kinds), count):
            time.sleep(self._period)
            getattr(self, "_" + kind.replace("'", "").replace(" ", "_"))()
            self.made[kind] += 1

    def _server(self):
        return self._random.choice(self._setup.servers)

    def _wait(self, times=1.0):
        time.sleep(self._random.uniform(0, times * self._pause))

    def _kill(self):
        server = self._server()
        server.kill()
        server.start()

    def _stop(self):
        server = self._server()
        server.stop()
        self._wait()
        server.resume()

    def _restart(self):
        self._server().restart()

    def _cut(self):
        """What waited arrives in the end, also at a server that has lost its sessions to another one."""
        link = self._random.choice(self._setup.links)
        link.cut()
        self._wait(LATE)
        link.heal()

    def _drop_datagrams(self):
        """A firewall drops them for a while."""
        relay = self._random.choice(self._setup.relays)
        relay.drops = True
        self._wait(LATE)
        relay.drops = False

    def _change_addresses(self):
        """The NAT before a server forgets its robots, which come from other ports then."""
        self._random.choice(self._setup.relays).rebind()

    def _fill_the_store(self):
        redis = self._setup.redis
        if redis is None:
            filler = fill(self._setup.disk)
            self._wait()
            filler.unlink()
        else:
            redis.command("CONFIG SET maxmemory 1")  # noeviction: writes are refused
            self._wait()
            redis.command("CONFIG SET maxmemory 0")

    def _lose_the_tail(self):
        redis, servers = self._setup.redis, self._setup.servers
        redis.process.send_signal(signal.SIGSTOP)
        self._wait()
        for server in servers:
            server.kill()
        redis.kill()  # with what has arrived since it stopped
        redis.start()
        for server in servers:
            server.start()

    def _take_over(self):
        """Lets any server claim any session, again and again."""
        ends = time.monotonic() + self._random.uniform(0, self._pause)
        while time.monotonic() < ends:
            claim(self._random.choice(self._setup.direct), self._random.choice(self._flights).pilot.session_id)

    def _sleep(self):
        """Lets the clock of a robot jump that counts its sleep; all pilots in Python have the same one."""
        robots = [flight for i, flight in enumerate(self._flights) if i == 0 or isinstance(flight, CppFlight)]
        self._random.choice(robots).suspend(self._random.uniform(1, 15))

    def _stop_robots(self):
        processes = [flight.pilot.process for flight in self._flights if isinstance(flight, CppFlight)]
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        self._wait()
        for process in processes:
            process.send_signal(signal.SIGCONT)

    def _jump_the_servers_clock(self):
        """Some servers start with it and some run through it, because other faults kill them."""
        self._setup.server_clock.jump(self._random.choice([25 * 3600, 400 * DAY, -425 * DAY]))

    def _jump_the_robots_clock(self):
        self._setup.robot_clock.jump(self._random.choice([25 * 3600, 400 * DAY, -425 * DAY]))

    def _another_robot(self):
        """A second robot has the id of a session by mistake, and sends what it has seen instead of the first one."""
        flight = self._random.choice(self._flights)
        session = METHODS["GetSession"].request(session_id=flight.pilot.session_id)
        states = [client.call("GetSession", session) for client in self._setup.direct]
        state = min(states, key=lambda one: (one.decisions, one.episode))
        seen = {"observation": [9.0] * SIZES[flight.policy]}
        executed = {"discrete": 0} if flight.policy == "cartpole" else {"continuous": {"values": [0.0]}}
        steps = range(state.step - BEHIND, state.step) if state.step >= BEHIND else [-1]
        history = [seen | {"step": step, "executed": executed} for step in steps]
        place = {"session_id": state.session_id, "step": state.step, "decision": state.decisions}
        request = METHODS["Act"].request(**place, **seen, history=history)
        message = refusal_of(self._random.choice(self._setup.direct), "Act", request)
        self.told += "another robot" in message  # or the first one has gone on
