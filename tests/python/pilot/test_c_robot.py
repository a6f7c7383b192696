"""A robot in C keeps the promises of the other pilots, with the shared library of its package."""

import math
import re

import pytest
import spikeserve
from robot_programs import ROOT, OtherPilot, build_c, installed
from security import until
from serving import run, running_server
from test_datagrams import DatagramFlight
from test_pilot import (  # noqa: F401
    PERIOD,
    client,
    test_a_cable_that_is_pulled_costs_nothing,
    test_a_quick_link_gives_fresh_actions,
    test_a_server_that_loses_its_sessions_gets_a_new_one,
    test_each_beat_says_who_chose_its_action,
    test_what_a_safety_layer_executes_is_what_the_server_remembers,
)

AUTO, STREAM, DATAGRAM = range(3)
HEADER = ROOT / "client/c/spikeserve_robot.h"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_c(tmp_path_factory.mktemp("program"))


@pytest.fixture
def fly(program):
    """Returns what makes a flight of the program."""

    class Flight(DatagramFlight):
        def make_pilot(self, *arguments, **options):
            return OtherPilot(program, *arguments, **options)

    return Flight


def test_the_library_exports_what_the_header_declares_and_nothing_else():
    symbols = run("nm", "--dynamic", "--defined-only", installed()[0] / "libspikeserve_robot.so.0").stdout
    declared = re.findall(r"^\w[\w* ]*?\b(spikeserve_robot_\w+)\(", HEADER.read_text(), re.MULTILINE)
    assert sorted(re.findall(r" T (\w+)@@SPIKESERVE_ROBOT_0$", symbols, re.MULTILINE)) == sorted(declared)
    assert len(symbols.splitlines()) == len(declared) + 1  # and the version
    run("g++", "-fsyntax-only", "-Wall", "-Wextra", "-pedantic", "-Werror", "-x", "c++", HEADER)


def test_the_program_of_the_page_plays(address, tmp_path):
    page = (ROOT / "docs/start/c.md").read_text()
    source = tmp_path / "page.c"
    source.write_text(re.search(r"```c\n(.*?)```", page, re.DOTALL)[1].replace("127.0.0.1:50051", address))
    assert run(build_c(tmp_path, source), env=installed()[1]).stdout.startswith("fresh ")


def test_the_engine_on_the_robot_and_the_robots_own_function(client, link, fly):
    for source, options in (("local", {}), ("safe", {"local": False, "action": "0.5"})):
        with fly(client, **options) as flight:
            flight.until("fresh")
            link.cut()
            flight.until(source)
            while source == "safe" and flight.beat().action != [0.5]:
                pass
            link.heal()
            flight.until("fresh")
            assert flight.pilot.stats().failures == 0


@pytest.mark.parametrize("action", ["nan", "-0.7"])
def test_numbers_are_no_index_of_a_discrete_space(client, link, fly, action):
    with fly(client, "cartpole", local=False, action=action) as flight:
        flight.until("fresh")
        link.cut()
        until(lambda: flight.beat() and flight.pilot.stats().failures > 0)
        assert flight.pilot.stats().invalid == 0
        flight.pilot.beat([0.0] * 4, executed_action=[1.0])
        assert flight.pilot.stats().invalid == 1


def test_steps_go_as_datagrams(fly):
    with running_server(flags=["--datagram_listen=127.0.0.1:0"]) as server, spikeserve.Client(server.grpc) as client:
        for transport in (AUTO, STREAM, DATAGRAM):
            with fly(client, local=False, transport=transport) as flight:
                flight.until("fresh")
                flight.until_datagrams(transport != STREAM)
                assert (flight.pilot.stats().datagram_answers > 0) == (transport != STREAM)


def test_a_robot_that_is_held_can_say_so(fly):
    with (
        running_server() as server,
        spikeserve.Client(server.grpc) as client,
        spikeserve.Operator(client, "ann") as operator,
        fly(client, local=False) as flight,
    ):
        flight.until("fresh")
        assert not flight.pilot.stats().stays_safe
        operator.hold(policy="pendulum", reason="smoke", wait=0.0)
        until(lambda: flight.beat() and flight.pilot.stats().stays_safe)


def test_times_without_an_end_have_none(client, link, fly):
    with fly(client, local=False, max_age=math.inf) as flight:
        flight.until("fresh")
        link.delay = 0.1
        flight.end()
        assert flight.summaries[0].result(math.inf).steps == len(flight.actions)


def test_errors_name_the_field_and_have_a_code(address, program):
    with pytest.raises(spikeserve.InvalidArgumentError, match="period: expected 1ms to 1h, received 0"):
        OtherPilot(program, address, "pendulum", 0)
    with pytest.raises(spikeserve.NotFoundError):
        OtherPilot(program, address, "no-such-policy", PERIOD)
    with pytest.raises(spikeserve.FailedPreconditionError, match="the server takes no datagrams"):
        OtherPilot(program, address, "pendulum", PERIOD, transport=DATAGRAM)
    pilot = OtherPilot(program, address, "pendulum", PERIOD)
    with pytest.raises(spikeserve.InvalidArgumentError, match="observation: expected 3 numbers, received 2"):
        pilot.beat([0.0, 0.0])
    pilot.close()
