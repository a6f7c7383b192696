"""Steps as datagrams: the pilots use them where they come through, and nothing is lost or doubled."""

import contextlib

import pytest
import spikeserve
from cpp_pilot import CppPilot
from datagram_relay import DatagramRelay
from restartable_server import RestartableServer
from spikeserve.piloting.datagram_link import require_ciphers
from test_pilot import Flight, undisturbed

# The label of a session with a channel, which is part of its value.
SESSION = spikeserve.SessionOptions(labels={"datagrams": "true"})


class DatagramFlight(Flight):
    def until_datagrams(self, are_sent=True):
        """Plays beats until steps go as datagrams alone, or no longer do."""
        self.fly_until(lambda: self.pilot.stats().sends_datagrams == are_sent)

    def check_and_end(self, client):
        self.until("fresh")
        self.end()
        with undisturbed(has_store=self.is_stored) as other:
            self.check_equal(client, other)


class CppDatagramFlight(DatagramFlight):
    make_pilot = CppPilot


@pytest.fixture
def relay():
    with DatagramRelay() as relay:
        yield relay


@pytest.fixture
def server(relay, tmp_path):
    """A server that keeps its sessions, whose datagrams go through the relay."""
    server = RestartableServer(f"--session_store=file:{tmp_path}", relay=relay)
    server.start()
    yield server
    server.kill()


@pytest.fixture
def client(server):
    with spikeserve.Client(server.address) as client:
        yield client


@pytest.fixture(params=[DatagramFlight, CppDatagramFlight], ids=["python", "cpp"])
def fly(client, request):
    """Returns what makes a flight, whose program ends with the test."""
    with contextlib.ExitStack() as stack:

        if request.param is DatagramFlight:
            require_ciphers()

        def begin(**options):
            flight = request.param(client, session=SESSION, local=False, **options)
            flight.is_stored = True
            if isinstance(flight, CppDatagramFlight):
                stack.callback(flight.pilot.end)
            return stack.enter_context(flight)

        yield begin


def test_steps_go_as_datagrams(client, relay, fly):
    flight = fly()
    flight.until_datagrams()
    before = flight.pilot.stats().datagram_answers
    flight.fly(30)
    flight.end()
    flight.until_datagrams()
    flight.fly(5)
    assert flight.pilot.stats().datagram_answers > before + 10
    flight.check_and_end(client)


@pytest.mark.parametrize("redundancy", [1, 2])
def test_lost_doubled_and_reordered_datagrams_change_nothing(client, relay, fly, redundancy):
    flight = fly(redundancy=redundancy)
    flight.until_datagrams()
    relay.loss = relay.doubled = relay.reordered = 0.2
    for _ in range(3):
        flight.fly(40)
        flight.end()
    flight.check_and_end(client)
    stats = flight.pilot.stats()
    assert stats.datagram_answers > 20 and stats.reopened == stats.lost_episodes == 0


def test_a_firewall_costs_nothing_of_the_session(client, relay, fly):
    flight = fly()
    flight.until_datagrams()
    relay.drops = True
    flight.until_datagrams(False)
    flight.until("fresh")
    relay.drops = False
    flight.until_datagrams()
    flight.check_and_end(client)


def test_a_robot_whose_address_changes_goes_on(client, relay, fly):
    flight = fly()
    flight.until_datagrams()
    relay.rebind()
    before = flight.pilot.stats().datagram_answers
    flight.fly_until(lambda: flight.pilot.stats().datagram_answers >= before + 5)
    flight.check_and_end(client)


def test_the_server_that_takes_a_session_over_brings_its_channel(client, server, relay, fly):
    flight = fly()
    flight.until_datagrams()
    server.kill()
    flight.until_datagrams(False)
    server.start()
    flight.until_datagrams()
    flight.check_and_end(client)


def test_a_pilot_may_want_no_datagrams(client, relay, fly):
    flight = fly(transport="stream")
    flight.until("fresh")
    flight.fly(10)
    assert relay.forwarded == flight.pilot.stats().datagram_answers == 0


def test_a_pilot_may_insist_on_datagrams(fly):
    flight = fly(transport="datagram")
    flight.until_datagrams()
    expected = "transport: expected k?[Aa]uto or k?[Ss]tream, because the server takes no datagrams"
    with undisturbed() as other, pytest.raises(spikeserve.SpikeserveError, match=expected):
        flight.make_pilot(other, "pendulum", 0.01, local=False, transport="datagram")
