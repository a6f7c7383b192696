"""Every shell of core/robot flies through tests/scenarios/link_events.txt, over real links, all at the same time.

Compared with the file, and so with each other and with the simulator (tests/unit/robot/simulator_test.cc): the number of steps of
every episode, and each reward, once; the sources of the steps of each event, of which only the number of fresh ones is a matter
of time; that an answer comes again; and that the session is lost once, by the event that loses it. The histories: the session of
each shell equals, bit for bit, one on a server that nothing disturbs and that was told the same steps.
"""

import concurrent.futures
import contextlib
import functools
import itertools
import os
import shutil
import threading
from types import SimpleNamespace

import pytest
import spikeserve
from datagram_relay import DatagramRelay
from links import Link
from machine import Clock
from replicated import claim, running_fleet
from robot_programs import ROOT, OtherPilot, build_c
from spikeserve.wire import METHODS
from test_cpp_pilot import CppFlight
from test_pilot import WAIT, Flight, undisturbed
from test_rust_and_go_robots import build_go, build_rust, with_sources

HOLD, OLDEST, ASLEEP = 50, 30.0, 60  # steps, seconds, seconds
OPTIONS = {"period": 0.02, "max_age": OLDEST, "hold_beats": HOLD, "local": False}
SESSION = spikeserve.SessionOptions(durability="ASYNC", labels={"datagrams": "true"})
# Of relays and links, while an event lasts. Datagrams, which know no delay, do not come through when the link is late.
SETTINGS = {
    "loss": [("relays", "loss", 0.3), ("links", "loss", 0.02)],
    "duplicate": [("relays", "doubled", 1.0)],
    "reorder": [("relays", "reordered", 0.5)],
    "late": [("relays", "drops", True), ("links", "delay", 0.1)],
}


def read_events():
    lines = (ROOT / "tests/scenarios/link_events.txt").read_text().splitlines()
    events = [line.split() for line in lines if not line.startswith("#")]
    return [(kinds.split("+"), int(steps), source, end) for kinds, steps, source, *end in events]


class ProgramFlight(Flight):
    """Flies a program in C, Rust or Go, whose clocks are `clock`."""

    def __init__(self, clock, *arguments, **options):
        self.machine = clock
        super().__init__(*arguments, prefix=clock.prefix, **options)

    def suspend(self, seconds):
        self.machine.jump(0, asleep=seconds)


class Events:
    """Generators by the names of kinds of events, which begin one, and end it when they go on."""

    def __init__(self, fleet, flights, together):
        self.fleet, self.flights, self.together = fleet, flights, together
        self.turn = 0  # of the servers, to fail

    def _next_server(self):
        self.turn += 1
        return self.fleet.servers[self.turn % 2]

    def begin(self, kind):
        event = self._settings(kind) if kind in SETTINGS else getattr(self, kind.replace("-", "_"))()
        next(event)
        return event

    def _settings(self, kind):
        for things, name, value in SETTINGS[kind]:
            self._set(things, name, value)
        yield
        for things, name, _ in SETTINGS[kind]:
            self._set(things, name, 0)

    def _set(self, things, name, value):
        for thing in getattr(self.fleet, things):
            setattr(thing, name, value)

    def black_hole(self):
        self._set("relays", "drops", True)
        for link in self.fleet.links:
            link.hold_answers()
        yield
        self._heal()

    def cut(self):
        self._set("relays", "drops", True)
        for link in self.fleet.links:
            link.cut()
            link.drop()
        yield
        self._heal()

    def _heal(self):
        self._set("relays", "drops", False)
        for link in self.fleet.links:
            link.heal()

    def suspend(self):
        hole = self.black_hole()
        next(hole)
        self.together(lambda flight: flight.suspend(ASLEEP))
        yield
        next(hole, None)

    def kill(self):
        for server in self.fleet.servers:
            server.kill()
        yield
        for server in self.fleet.servers:
            server.start()

    def fail_over(self):
        server = self._next_server()
        server.kill()
        yield
        server.start()

    def drain(self):
        ending = threading.Thread(target=self._next_server().restart)
        ending.start()
        yield
        ending.join()

    def take_over(self):
        for client, flight in itertools.product(self.fleet.direct, self.flights.values()):
            claim(client, flight.pilot.session_id)
        yield

    def clock_jump(self):
        self.fleet.clock.jump(25 * 3600)
        yield

    def full(self):
        self.fleet.redis.command("CONFIG SET maxmemory 1")  # noeviction: writes are refused
        yield
        self.fleet.redis.command("CONFIG SET maxmemory 0")

    def lost(self):
        for flight in self.flights.values():
            claim(self.fleet.direct[0], flight.pilot.session_id)
            request = METHODS["CloseSession"].request(session_id=flight.pilot.session_id)
            self.fleet.direct[0].call("CloseSession", request)
        yield


def take_answer(flight):
    """Waits for an answer, as a robot that stands still, and takes it."""
    # On a busy machine a step may have taken longer than a period, so its action's age says nothing: the observation's age when
    # the step began does.
    if flight.actions[-1].source == "fresh" and flight.ages[-1] < flight.period / 2:  # of its own step: there is none to wait for
        return flight.beat()
    assert flight.pilot.wait_ready(WAIT), flight.pilot.stats()
    action = flight.beat()
    assert action.source == "fresh", action
    return action


def check_sources(before, sources, source):
    """Checks the sources from an event on; on a busy machine steps `before` it may be held, too."""
    safe = sources.index("safe") if "safe" in sources else len(sources)
    if source == "fresh":
        assert safe == len(sources), sources
    if source in ("safe", "stale"):
        assert set(sources[safe:]) == {"safe"}, sources
        earlier = [*before, *sources[:safe]] if source == "safe" else sources[:safe]
        held = HOLD if source == "safe" else 0
        assert [*reversed(earlier), "fresh"].index("fresh") == held, (before, sources)


@pytest.fixture
def fleet(tmp_path):
    clock = Clock(tmp_path / "clock")
    with contextlib.ExitStack() as stack:
        relays = [stack.enter_context(DatagramRelay(seed=i)) for i in range(2)]
        running = stack.enter_context(running_fleet("--session_ttl=24h", prefix=clock.prefix, relays=relays))
        links = [stack.enter_context(Link(server.address)) for server in running.replicas]
        direct = [stack.enter_context(spikeserve.Client(server.address)) for server in running.replicas]
        client = stack.enter_context(spikeserve.Client(",".join(link.address for link in links)))
        things = {"clock": clock, "redis": running.redis, "servers": running.replicas}
        yield SimpleNamespace(**things, relays=relays, links=links, direct=direct, client=client)


@pytest.fixture
def flights(fleet, tmp_path):
    """Yields a flight of each shell, by its name."""
    kinds = {"python": Flight, "c++": CppFlight}
    for name, build in {"c": build_c, "rust": build_rust, "go": build_go}.items():
        compiler = {"c": "gcc", "rust": "cargo"}.get(name, name)
        if not shutil.which(compiler):
            assert not os.environ.get("CI"), f"{compiler}: expected what `deploy/setup.sh` installs, found none"
            continue
        (tmp_path / name).mkdir()
        program = build(with_sources(tmp_path / name))
        make = staticmethod(lambda *arguments, program=program, **options: OtherPilot(program, *arguments, **options))
        kind = type(name, (ProgramFlight,), {"make_pilot": make})
        kinds[name] = functools.partial(kind, Clock(tmp_path / name / "clock"))
    with contextlib.ExitStack() as stack:
        started = {name: kind(fleet.client, session=SESSION, **OPTIONS) for name, kind in kinds.items()}
        stack.callback(started["c++"].pilot.end)
        for flight in started.values():
            stack.enter_context(flight)
        yield started


def test_every_shell_flies_the_scenario(fleet, flights):
    events = read_events()
    assert len(events) == 40
    with concurrent.futures.ThreadPoolExecutor(len(flights)) as threads:

        def together(do):
            return dict(zip(flights, threads.map(do, flights.values()), strict=True))

        made = Events(fleet, flights, together)
        together(lambda flight: flight.fly(1))
        for kinds, steps, source, end in events:
            together(take_answer)
            before = together(lambda flight: flight.fly(2))
            if "lost" in kinds:
                check_histories(fleet, flights, together)
            begun = [made.begin(kind) for kind in kinds]
            for name, sources in together(lambda flight, steps=steps: flight.fly(steps)).items():
                try:
                    check_sources(before[name], sources, source)
                except (AssertionError, ValueError) as error:
                    raise AssertionError(f"{name} at {'+'.join(kinds)}") from error
            if end:
                together(lambda flight: (flight.end(), flight.fly(2)))
            if source == "back":
                together(take_answer)
            for event in begun:
                next(event, None)
        together(take_answer)
        together(lambda flight: flight.end())
        for name, flight in flights.items():
            flight.check_summaries()
            stats = flight.pilot.stats()
            assert (stats.reopened, stats.lost_episodes, stats.failures) == (1, 0, 0), (name, stats)
            assert [len(episode) for episode in flight.episodes] == [len(episode) for episode in flights["python"].episodes]


def check_histories(fleet, flights, together):
    """Compares the sessions, before they are lost."""
    together(lambda flight: flight.end())
    with undisturbed() as other:
        for flight in flights.values():
            flight.check_summaries()
            claim(fleet.direct[0], flight.pilot.session_id)
            flight.check_equal(fleet.direct[0], other)
