"""A pilot with the engine on the robot, which continues in the same session while the link is cut."""

from dataclasses import replace

import pytest
import spikeserve
from redis_servers import WITHOUT_REDIS
from restartable_server import restartable_server
from security import until
from serving import SHIPPED_POLICIES, running_server
from spikeserve.channels import Channels
from spikeserve.lines import LineRenewedError
from test_pilot import LEARNING, MAX_AGE, Flight, client, exported, fly  # noqa: F401
from test_pilot import fly_through_cuts, fly_through_five_seconds, of_both_kinds


@of_both_kinds
def test_with_an_engine_a_pulled_cable_costs_nothing(client, link, policy, options, fly):
    with fly(client, policy, session=options, local_policy=SHIPPED_POLICIES) as flight:
        fly_through_cuts(flight, client, link, source="local")


def test_with_an_engine_five_seconds_without_a_cable_cost_no_action(client, link, fly):
    with fly(client, local_policy=SHIPPED_POLICIES, max_age=MAX_AGE) as flight:
        fly_through_five_seconds(flight, client, link)
        assert flight.pilot.stats().local > 0


def test_the_engine_on_the_robot_plays_the_same_session(client, link, fly):
    with fly(client, "cartpole", session=LEARNING) as flight:
        assert flight.pilot.stats().has_local  # the server has sent the policy
        flight.until("fresh")
        link.cut()
        flight.until("local")
        flight.end()
        flight.fly(10)
        link.heal()
        flight.until("fresh")
        until(lambda: flight.local_value() == exported(client, flight.pilot.session_id))


def test_the_engine_on_the_robot_skips_what_the_robot_did_not_see(client, link, fly):
    with fly(client, "cartpole", session=LEARNING) as flight:
        flight.until("fresh")
        flight.blind(3)
        flight.fly(5)
        link.cut()
        flight.until("local")
        assert not any(action.source == "local" for action in flight.blind(10))
        flight.until("local")
        flight.blind(2)
        flight.end()
        flight.blind(2)
        flight.until("local")
        flight.blind(1)
        flight.until("local")
        link.heal()
        flight.until("fresh")
        assert flight.pilot.stats().failures == 0
        until(lambda: flight.local_value() == exported(client, flight.pilot.session_id))
        flight.end()
        flight.check_summaries()


def test_a_server_may_withhold_its_policies(fly):
    with running_server(flags=["--withhold_policies"]) as server, spikeserve.Client(server.grpc) as client:
        with fly(client) as flight:
            flight.until("fresh")
            assert not flight.pilot.stats().has_local
        with fly(client, local_policy=SHIPPED_POLICIES) as flight:
            assert flight.pilot.stats().has_local
        with pytest.raises(ValueError, match="local_policy: expected the policy file, received none"):
            fly(client, local=True)
        wrong = SHIPPED_POLICIES / "cartpole/1/policy.safetensors"
        with pytest.raises(ValueError, match="local_policy: expected the file with SHA-256"):
            fly(client, local=True, local_policy=wrong)


@WITHOUT_REDIS
def test_an_export_that_fails_keeps_no_episode_from_its_end(redis, monkeypatch):
    """The engine wants the head of the fleet after each episode, whose end needs a call of its own."""
    options = replace(LEARNING, durability="ASYNC", learning=replace(LEARNING.learning, scope="FLEET"))
    send = Channels._send

    def send_no_export(self, line, call, request, timeout):
        if call.method == "ExportSession":
            raise LineRenewedError
        return send(self, line, call, request, timeout)

    with restartable_server(f"--session_store=redis://127.0.0.1:{redis.port}") as server:
        with spikeserve.Client(server.address) as client, Flight(client, "cartpole", session=options) as flight:
            flight.until("fresh")
            monkeypatch.setattr(Channels, "_send", send_no_export)
            for _ in range(3):
                flight.fly(5)
                flight.end()
            flight.check_summaries()
            assert flight.pilot.stats().has_local
