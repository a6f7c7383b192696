"""The pilot of the C++ client keeps the promises of the Python one: the same tests, and those of C++ alone."""

import pytest
import spikeserve
import test_pilot
from cpp_pilot import CppPilot
from security import tls_flags
from serving import SHIPPED_POLICIES, running_server
from test_pilot import (  # noqa: F401
    PERIOD,
    client,
    test_a_cable_that_is_pulled_costs_nothing,
    test_a_connection_that_a_nat_has_forgotten_is_replaced,
    test_a_pilot_that_closes_fails_what_the_server_does_not_have,
    test_a_quick_link_gives_fresh_actions,
    test_a_server_that_loses_its_sessions_gets_a_new_one,
    test_an_answer_that_is_stale_is_never_executed,
    test_an_end_that_never_arrived_is_sent_again,
    test_each_beat_says_who_chose_its_action,
    test_episodes_that_end_while_the_link_is_cut_are_not_lost,
    test_five_seconds_without_a_cable_cost_no_action,
    test_nothing_that_a_robot_passes_makes_a_beat_fail,
    test_the_next_episode_does_not_wait_for_the_answer_to_the_end,
    test_what_a_safety_layer_executes_is_what_the_server_remembers,
)
from test_pilot_engine import (  # noqa: F401
    test_the_engine_on_the_robot_plays_the_same_session,
    test_the_engine_on_the_robot_skips_what_the_robot_did_not_see,
    test_with_an_engine_a_pulled_cable_costs_nothing,
    test_with_an_engine_five_seconds_without_a_cable_cost_no_action,
)
from test_pilot_faults import (  # noqa: F401
    test_a_blind_robot_is_not_reported_fresh,
    test_a_robot_may_wait_until_an_answer_is_there,
    test_a_robot_that_is_wired_wrong_hears_it_at_its_first_step,
    test_a_server_hears_of_a_robot_that_stays_blind,
    test_a_server_that_denies_the_session_has_not_the_last_word,
    test_an_episode_of_a_fleet_ends_behind_a_step_that_saw_nothing,
    test_episodes_begin_and_end_without_an_observation,
    test_what_a_kill_loses_the_robot_sends_again,
)
from test_pilot_options import REFUSED, test_times_without_an_end_have_none  # noqa: F401
from traces import collecting, environment

WARM = 20  # beats after which nothing is allocated


class CppFlight(test_pilot.Flight):
    make_pilot = CppPilot

    def local_value(self):
        return self.pilot.value()

    def suspend(self, seconds):
        self.pilot.suspend(seconds)


@pytest.fixture
def fly():
    """Returns what makes a flight, whose program ends with the test."""
    pilots = []

    def start(*arguments, **options):
        flight = CppFlight(*arguments, **options)
        pilots.append(flight.pilot)
        return flight

    yield start
    for pilot in pilots:
        pilot.end()


def test_no_beat_allocates_memory(client, link, fly):
    """On every source: fresh, held, from the engine, and safe."""
    for local in (None, False):
        with fly(client, local=local) as flight:
            flight.until("fresh")
            flight.fly(WARM)
            link.cut()
            flight.until("safe" if local is False else "local")
            flight.fly(WARM)
            link.heal()
            flight.until("fresh")
            assert set(flight.pilot.allocations[WARM:]) == {0}


def test_the_newest_answer_that_could_arrive_is_executed(client, link, fly):
    """At 50 Hz, with a round trip of 50 ms, and 1 % of the segments lost."""
    link.delay, link.loss = 0.025, 0.01
    with fly(client, period=0.02, local=False, watches_answers=True) as flight:
        executed, newest = -1, []
        for _ in range(300):
            action = flight.beat()
            if action.source == "fresh":
                executed = max(executed, action.answers)
            newest.append(executed >= action.newest)
        assert action.newest > 0 and sum(newest) >= 0.95 * len(newest)
        # With one request at a time, one beat of three would have an answer. All are older than a period.
        assert flight.pilot.stats().late_answers >= 0.5 * len(newest)
        flight.end()
        flight.check_session(client)


def test_each_request_belongs_to_the_trace_of_its_beat(fly, monkeypatch):
    trace, span = "a" * 32, "b" * 16
    with collecting() as collector:
        for name, value in environment(collector.port).items():
            monkeypatch.setenv(name, value)
        with running_server() as server, spikeserve.Client(server.grpc) as client:
            with fly(client, local=False, traceparent=f"00-{trace}-{span}-01") as flight:
                flight.until("fresh")
                call = collector.find("spikeserve.v1.PolicyService/ActStream", trace=trace, parent=span)
                collector.find("decide", trace=trace, parent=call.id)


def test_tls_and_tokens(certificates, tokens, fly):
    with running_server(flags=tls_flags(certificates, f"--tokens={tokens}")) as server:
        with fly(server.grpc, ca=f"{certificates}/ca.pem", token="agent", local=False) as flight:
            flight.until("fresh")
            flight.end()
            flight.check_summaries()


def test_what_the_robots_own_function_throws_is_no_concern_of_a_beat(client, link, fly):
    with fly(client, local=False, throwing=True, ramp_beats=0) as flight:
        flight.until("fresh")
        link.cut()
        flight.until("safe")
        assert flight.actions[-1].action == [0.0]
        assert flight.pilot.stats().failures > 0
        link.heal()


def test_rungs_are_logged_once(client, link):
    flight = CppFlight(client, local=False)
    with flight:
        flight.until("fresh")
        link.cut()
        flight.until("safe")
        flight.fly(50)
        entries = flight.pilot.stats().entries["safe"]
        link.heal()
    lines = [line for line in flight.pilot.end().splitlines() if line.startswith("pilot: safe after")]
    assert 1 <= len(lines) <= entries < 10


def test_an_engine_that_cannot_play_is_an_error_at_the_begin():
    with running_server(flags=["--withhold_policies"]) as server:
        with pytest.raises(spikeserve.FailedPreconditionError, match="expected the policy file from the server"):
            CppFlight(server.grpc)
        wrong = SHIPPED_POLICIES / "cartpole/1/policy.safetensors"
        with pytest.raises(spikeserve.FailedPreconditionError, match="expected the policy file with SHA-256"):
            CppFlight(server.grpc, local_policy=wrong)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": 0}, "period: expected 1ms to 1h, received 0"),
        ({"budget": 1}, r"budget: expected 0 to period \(10ms\), received 1s"),
        *REFUSED,
    ],
)
def test_the_options_are_checked(address, options, message):
    with pytest.raises(spikeserve.InvalidArgumentError, match=message):
        CppPilot(address, "pendulum", **{"period": PERIOD, "local": False} | options)


def test_the_server_must_be_there_when_a_pilot_is_made():
    with pytest.raises(spikeserve.UnavailableError):
        CppPilot("127.0.0.1:1", "pendulum", PERIOD, local=False, patience=0.1)
