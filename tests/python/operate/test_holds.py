"""Holds: robots that take their neutral action until an operator resumes them."""

import contextlib
import threading

import pytest
import spikeserve
from cpp_pilot import CppPilot
from redis_servers import WITHOUT_REDIS
from replicated import running_fleet
from restartable_server import restartable_server
from security import ADMIN, OBSERVATION, service_with, until
from serving import run, running_server
from test_operators import operating

PILOT = {"period": 0.02, "local": False, "ramp_beats": 0}
NORTH = spikeserve.SessionOptions(labels={"site": "north"}, durability="ASYNC")


class Flight:
    """Beats with a pilot until it is closed, and keeps the sources."""

    def __init__(self, pilot):
        self.pilot = pilot
        self.sources = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._fly)
        self._thread.start()

    def _fly(self):
        while not self._over.wait(0.01):
            self.sources.append(self.pilot.beat([0.6, 0.8, 0.1], 0.0).source)

    def close(self):
        self._over.set()
        self._thread.join()
        self.pilot.close()


@WITHOUT_REDIS
def test_a_hold_outlives_every_server():
    with running_fleet(replicas=2) as fleet, operating(fleet.addresses) as (client, operator):
        silent = client.open_session("pendulum", NORTH)
        silent.act([0.6, 0.8, 0.1])
        south = client.open_session("pendulum", spikeserve.SessionOptions(labels={"site": "south"}, durability="SYNC"))
        with contextlib.ExitStack() as stack:
            pilots = [make(client, "pendulum", session=NORTH, **PILOT) for make in (spikeserve.Pilot, CppPilot)]
            flights = [stack.enter_context(contextlib.closing(Flight(pilot))) for pilot in pilots]
            for flight in flights:
                until(lambda flight=flight: "fresh" in flight.sources[-3:])
            held = operator.hold(label="site=north", reason="smoke", wait=0.0)
            assert held.kept and not held.unreached
            assert len(held.robots) == 3
            until(lambda: [r.session_id for r in operator.verdict(held.id).not_confirmed] == [silent.session_id])
            since = [len(flight.sources) for flight in flights]
            assert south.act([0.6, 0.8, 0.1]).hold is None

            for server in fleet.replicas:
                server.kill()
            for server in fleet.replicas:
                server.start()
            sessions = {pilot.session_id for pilot in pilots}
            until(lambda: {r.session_id for r in operator.verdict(held.id).robots if r.at_neutral} == sessions)
            until(lambda: [r.session_id for r in operator.verdict(held.id).robots if r.only_stored] == [silent.session_id])
            late = client.open_session("pendulum", NORTH)
            decision = late.act([0.6, 0.8, 0.1])
            assert decision.hold == spikeserve.Hold(held.id, "smoke")
            assert (decision.source, decision.action.tolist()) == ("HOLD", [0.0])
            for flight, begin in zip(flights, since, strict=True):
                assert set(flight.sources[begin:]) == {"safe"}
                assert flight.pilot.stats().stays_safe
            operator.resume(label="site=north")
            for flight in flights:
                until(lambda flight=flight: flight.sources[-1] == "fresh")
            until(lambda: late.act([0.6, 0.8, 0.1], 0.0).hold is None)
            with pytest.raises(spikeserve.NotFoundError):
                operator.resume(label="site=north")


def test_a_hold_is_kept_with_the_settings(tmp_path):
    flags = (f"--policy_settings={tmp_path}/settings.json", f"--session_store=file:{tmp_path}/sessions")
    with restartable_server(*flags) as server:
        with operating(server.address) as (client, operator):
            held = operator.hold(policy="cartpole", reason="smoke")
            assert held.kept and held.robots == ()
            assert operator.verdict(held.id).kept is None
            sessions = [client.open_session("cartpole", spikeserve.SessionOptions(durability="SYNC")) for _ in range(2)]
            server.kill()
            server.start()
            assert sessions[0].act(OBSERVATION).hold.id == held.id
            robots = {robot.session_id: robot.only_stored for robot in operator.verdict(held.id).robots}
            assert robots == {sessions[0].session_id: False, sessions[1].session_id: True}
            again = ("--policy=cartpole", "--wait=0s", "--reason=smoke", f"--id={held.id}")
            said = server.server.spikectl("hold", *again, status=None).stdout
            assert f"{sessions[1].session_id} cartpole/2 , in the store alone: has asked no server" in said
            assert client.open_session("pendulum").act([0.6, 0.8, 0.1]).hold is None


def test_a_server_that_refuses_a_hold_is_named(server):
    """Two servers without a common store, of which one has as many holds as it takes."""
    with contextlib.ExitStack() as stack:
        full = stack.enter_context(running_server())
        servers = f"{server.grpc},{full.grpc}"
        for number in range(64):
            full.admin.HoldSessions(id=f"hold-{number}", selection={"policy": "cartpole"})
        with operating(servers) as (_, operator):
            verdict = operator.hold(policy="pendulum", hold_id="fire", wait=0.0)
            assert list(verdict.unreached) == [full.grpc]
            assert "expected fewer than 64 holds" in verdict.unreached[full.grpc]
            said = run("spikectl", "hold", f"--server={servers}", "--policy=pendulum", "--id=fire", "--wait=0s", status=1)
            assert f"not reached: {full.grpc}: selection: expected fewer than 64 holds" in said.stdout
            operator.resume("fire")
            assert list(operator.verdict("fire").unreached) == [server.grpc, full.grpc]

            operator.hold(policy="pendulum", hold_id="smoke", wait=0.0)
            stack.close()
            for resumed in ({"hold_id": "smoke"}, {"policy": "pendulum"}):
                with pytest.raises(spikeserve.UnavailableError):  # that server may have it
                    operator.resume(**resumed)
            assert not server.admin.ListHolds().holds


def test_a_held_session_learns_nothing(server):
    learning = spikeserve.SessionOptions(learning=spikeserve.Learning(learning_rate=0.1), sample=True)
    with operating(server.grpc) as (client, operator), client.open_session("cartpole", learning) as session:
        for hold in (False, True, False):
            if hold:
                held = operator.hold(session_ids=[session.session_id], hold_id="one", wait=0.0)
                assert held.kept is False  # the server has no --policy_settings
            before = session.state(include_head_delta=True).head_delta
            for step in range(5):
                assert (session.act(OBSERVATION, float(step)).source == "HOLD") == hold
            session.end_episode(1.0, terminated=True)
            after = session.state(include_head_delta=True).head_delta
            assert (before.tolist() == after.tolist()) == hold
            if hold:
                operator.resume("one")


def test_resume_ends_what_was_held_by_this_selection_alone(tokens):
    with running_server(flags=[f"--tokens={tokens}"]) as server, contextlib.ExitStack() as stack:

        def operator(token):
            client = stack.enter_context(spikeserve.Client(server.grpc, spikeserve.ClientOptions(token=token)))
            return stack.enter_context(spikeserve.Operator(client, token))

        def held():
            return {hold.hold.id for hold in admin.ListHolds().holds}

        admin = stack.enter_context(service_with(server, "machine", ADMIN))
        machine, rival = operator("machine"), operator("rival-operator")
        for name, selection in (
            ("fleets", {"tenant": "fleet"}),
            ("all", {"all_sessions": True}),
            ("fleets-policy", {"tenant": "fleet", "policy": "cartpole"}),
            ("policy", {"policy": "cartpole"}),
        ):
            machine.hold(**selection, hold_id=name, wait=0.0)
        for nothing in ({}, {"hold_id": ""}, {"session_ids": []}):
            with pytest.raises(ValueError, match="selection: expected a hold_id, a condition, or all_sessions"):
                machine.resume(**nothing)
        with pytest.raises(spikeserve.NotFoundError, match="received policy 'cartpole', version 1"):
            machine.resume(policy="cartpole", version=1)
        assert held() == {"fleets", "all", "fleets-policy", "policy"}
        machine.resume(all_sessions=True)
        machine.resume(policy="cartpole")
        for again in ({"all_sessions": True}, {"policy": "cartpole"}):
            with pytest.raises(spikeserve.NotFoundError, match="expected that of a hold, such as the one with tenant 'fleet', received"):
                machine.resume(**again)
        assert held() == {"fleets", "fleets-policy"}
        machine.resume(tenant="fleet", policy="cartpole")

        # An operator of one tenant sees what holds all sessions, and does not end it instead of its own.
        for name, selection in (("all", {"all_sessions": True}), ("policy", {"policy": "cartpole"})):
            machine.hold(**selection, hold_id=name, wait=0.0)
            rival.hold(**selection, hold_id=f"rivals-{name}", wait=0.0)
            rival.resume(**selection)
        assert held() == {"fleets", "all", "policy"}
        rival.hold(policy="cartpole", hold_id="rivals", wait=0.0)
        other = operator("rival-operator")  # does not know the tenant of its token
        with pytest.raises(spikeserve.NotFoundError, match="such as the one with tenant 'rival', received policy 'cartpole'"):
            other.resume(policy="cartpole")
        other.resume(policy="cartpole", tenant="rival")
        assert held() == {"fleets", "all", "policy"}
