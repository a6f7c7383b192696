"""Operators who act in the place of policies, and what all operators may do with sessions."""

import contextlib
import json
import os
import pty
import subprocess
import time

import grpc
import pytest
import spikeserve
from redis_servers import WITHOUT_REDIS
from replicated import claim, running_fleet
from restartable_server import restartable_server
from security import ADMIN, OBSERVATION, code_of, fails_with, service_with, until
from serving import http_call, running_server, series

DENIED = grpc.StatusCode.PERMISSION_DENIED
INVALID = grpc.StatusCode.INVALID_ARGUMENT
NOT_FOUND = grpc.StatusCode.NOT_FOUND
REFUSED = grpc.StatusCode.FAILED_PRECONDITION
PARTS = ("unusual_observations", "entropy", "low_return", "fallbacks")


@contextlib.contextmanager
def operating(server, name="ann"):
    """Yields a client of a server, and an operator."""
    with spikeserve.Client(server) as client, spikeserve.Operator(client, name) as operator:
        yield client, operator


def test_what_is_refused(server):
    hold = server.admin.HoldSessions
    for fields, message in [
        ({}, "selection: expected a condition, or all"),
        ({"selection": {"version": 1}}, "selection.policy: expected a name"),
        ({"id": "a b", "selection": {"all": True}}, "id: expected letters"),
        ({"reason": "x" * 257, "selection": {"all": True}}, "reason: expected at most 256 bytes, received 257"),
        ({"selection": {"session_ids": ["x"] * 1001}}, "selection.session_ids: expected at most 1000"),
    ]:
        with fails_with(INVALID, message):
            hold(**fields)
    hold(id="same", selection={"policy": "hopper"})
    hold(id="same", selection={"policy": "hopper"})
    with fails_with(grpc.StatusCode.ALREADY_EXISTS, "id: "):
        hold(id="same", selection={"policy": "pendulum"})
    server.admin.ResumeSessions(id="same")
    with fails_with(NOT_FOUND, "id: "):
        server.admin.ResumeSessions(id="same")

    take, steer = server.admin.TakeControl, server.admin.SteerSession
    box = server.agent.OpenSession(policy="pendulum").session_id
    for fields, message in [
        ({"operator_id": ""}, "operator_id: expected 1 to 128 bytes"),
        ({"operator_id": "x" * 129}, "operator_id: expected 1 to 128 bytes, received 129"),
        ({"lease_seconds": 61.0}, "lease_seconds: expected 0.1 to 60, received 61"),
        ({"lease_seconds": float("nan")}, "lease_seconds: "),
        ({"lease_id": "x"}, "lease_id: expected 32 hexadecimal digits"),
        ({"action": {"discrete": 1}}, "action: expected continuous, received discrete"),
        ({"action": {"continuous": {"values": [3.0]}}}, "action[0]: expected -2 to 2, received 3"),
    ]:
        with fails_with(INVALID, message):
            take(**{"session_id": box, "operator_id": "ann"} | fields)
    with fails_with(REFUSED, "lease_id: expected a lease that has not ended"):
        steer(session_id=box, lease_id="0" * 32)
    lease = take(session_id=box, operator_id="ann", lease_seconds=60.0).lease_id
    with fails_with(INVALID, "action: expected 1 values, received 2"):
        steer(session_id=box, lease_id=lease, action={"continuous": {"values": [0.0, 0.0]}})
    with fails_with(REFUSED, 'the operator "ann" has control'):
        take(session_id=box, operator_id="bob")
    server.agent.CloseSession(session_id=box)
    for call in (steer, server.admin.ReturnControl):
        with fails_with(NOT_FOUND, box):
            call(session_id=box, lease_id=lease)


def test_tenants_and_roles(tokens):
    with running_server(flags=[f"--tokens={tokens}"]) as server, contextlib.ExitStack() as stack:

        def admin(token):
            return stack.enter_context(service_with(server, token, ADMIN))

        agent = stack.enter_context(service_with(server, "agent"))
        session = agent.OpenSession(policy="cartpole").session_id

        def answer(step):
            return agent.Act(session_id=session, step=step, observation=OBSERVATION)

        assert code_of(admin("agent").HoldSessions, selection={"all": True}) == DENIED
        assert code_of(admin("viewer").TakeControl, session_id=session) == DENIED
        rival = admin("rival-operator")
        with fails_with(DENIED, "selection.tenant: "):
            rival.HoldSessions(selection={"tenant": "fleet"})
        assert rival.HoldSessions(id="rivals", selection={"all": True}).hold.sessions == 0
        with fails_with(NOT_FOUND, session):
            rival.TakeControl(session_id=session, operator_id="eve")
        assert not answer(0).HasField("hold")
        assert code_of(admin("operator").ResumeSessions, id="rivals") == NOT_FOUND
        assert [hold.hold.id for hold in admin("viewer").ListHolds().holds] == []
        admin("machine").HoldSessions(id="fleets", selection={"tenant": "fleet"})
        assert answer(1).hold.id == "fleets"
        assert code_of(rival.ResumeSessions, id="rivals") == grpc.StatusCode.OK
        [resumed, *_] = rival.ListHistory().entries
        assert "rivals" in resumed.before and "fleets" not in resumed.before + resumed.after
        with fails_with(grpc.StatusCode.INVALID_ARGUMENT, "selection: expected at most 65536 bytes, received 100000"):
            rival.HoldSessions(selection={"session_ids": ["x" * 100] * 1000})
        [held] = admin("viewer").ListHolds(page_size=10).sessions
        assert (held.session_id, held.hold_id) == (session, "fleets")
        admin("operator").ResumeSessions(id="fleets")
        assert admin("nina").TakeControl(session_id=session).operator_id == "nina"
        assert answer(2).source.operator_id == "nina"
        actions = [each.action for each in admin("machine").ListHistory().entries]
        assert actions[:3] == ["TakeControl", "ResumeSessions", "HoldSessions"]


def test_one_operator_is_heard(server):
    with operating(server.grpc) as (client, ann), spikeserve.Operator(client, "bob") as bob:
        session = client.open_session("cartpole")
        of_policy = session.act(OBSERVATION).action
        with ann.take(session.session_id, lease=60.0, action=1 - of_policy) as control:
            decision = session.act(OBSERVATION, 1.0)
            assert (decision.source, decision.operator_id, decision.action) == ("OPERATOR", "ann", 1 - of_policy)
            with pytest.raises(spikeserve.FailedPreconditionError, match="ann"):
                bob.take(session.session_id)
            other = bob.take(session.session_id, lease=60.0, take_over=True)
            assert other.relieved == "ann"
            with pytest.raises(spikeserve.FailedPreconditionError, match="bob"):
                control.act(0)
            for action in (0, 1, 0):
                other.act(action)
                decision = session.act(OBSERVATION, 1.0)
                assert (decision.operator_id, decision.action) == ("bob", action)
            other.renew()
            assert other.steps == 3 and 0 <= other.agreed_steps <= 3
            other.release()
            assert session.act(OBSERVATION, 1.0).source == "POLICY"
            control = ann.take(session.session_id, lease=0.1)  # which nobody renews
            until(lambda: session.act(OBSERVATION, 1.0).source == "POLICY")
            with pytest.raises(spikeserve.FailedPreconditionError, match="has not ended"):
                control.renew()
            control = ann.take(session.session_id, lease=60.0)


@WITHOUT_REDIS
def test_control_goes_on_at_the_next_server():
    with running_fleet(replicas=2) as fleet, operating(fleet.addresses) as (client, operator):
        session = client.open_session("cartpole", spikeserve.SessionOptions(durability="SYNC"))
        session.act(OBSERVATION)
        with operator.take(session.session_id, lease=60.0, action=1) as control:
            for server in fleet.replicas:
                for action in (0, 1):

                    def is_heard(action=action):
                        # A session that moves meanwhile has the operator's action of its last decision.
                        control.act(action)
                        decision = session.act(OBSERVATION, 1.0)
                        assert decision.source == "OPERATOR"
                        return decision.action == action

                    until(is_heard)
                server.kill()
                decision = session.act(OBSERVATION, 1.0, timeout=30.0)
                assert (decision.source, decision.action) == ("OPERATOR", 1)
                server.start()
            control.renew()
            assert control.steps >= 6


def has_session(server, session):
    with spikeserve.AdminClient(server.address) as admin:
        return session.session_id in {each.session_id for each in admin.list_sessions().sessions}


@WITHOUT_REDIS
def test_a_hand_over_that_the_store_lacks_is_not_heard():
    """A server is cut off from the store, and killed: what it alone knew of operators, no robot has heard."""
    with running_fleet(replicas=2, linked=True) as fleet, operating(fleet.addresses) as (client, ann):
        session = client.open_session("cartpole", spikeserve.SessionOptions(durability="ASYNC"))
        heard = []

        def act():
            decision = session.act(OBSERVATION, 1.0, timeout=60.0)
            heard.append(decision.operator_id)
            return heard[-1]

        act()
        [owner] = [i for i, server in enumerate(fleet.replicas) if has_session(server, session)]
        with spikeserve.Operator(client, "bob") as bob, ann.take(session.session_id, lease=60.0) as control:
            assert act() == "ann"
            fleet.links[owner].cut()
            with pytest.raises((spikeserve.UnavailableError, spikeserve.DeadlineExceededError)):
                bob.take(session.session_id, lease=60.0, take_over=True)
            for _ in range(5):
                act()
            fleet.replicas[owner].kill()
            for _ in range(5):
                act()
            assert set(heard[2:]) == {"ann"}
            control.act(1)
            taken = bob.take(session.session_id, lease=60.0, take_over=True)
            assert (taken.relieved, act()) == ("ann", "bob")
            with pytest.raises(spikeserve.FailedPreconditionError, match="bob"):
                control.release()
            taken.release()
            assert act() == ""


@WITHOUT_REDIS
@pytest.mark.parametrize("call", ["take", "steer", "return"])
def test_a_former_owner_refuses_nobody(call):
    """It does not know yet that the session has moved, nor who has its seat now: operators are heard at the new owner."""
    with running_fleet(replicas=2) as fleet, contextlib.ExitStack() as stack:
        former, ann = stack.enter_context(operating(fleet.replicas[0].address))
        owner, bob = stack.enter_context(operating(fleet.replicas[1].address, "bob"))
        session = former.open_session("cartpole", spikeserve.SessionOptions(durability="SYNC"))
        ann.take(session.session_id, lease=60.0)
        claim(owner, session.session_id)
        control = bob.take(session.session_id, lease=60.0, take_over=True)
        _, everywhere = stack.enter_context(operating(fleet.addresses))  # asks the former owner first
        control._operator = everywhere
        if call == "take":
            bob._of_session("ReturnControl", session_id=session.session_id, lease_id=control.lease_id)
            everywhere.take(session.session_id)
        elif call == "steer":
            control.act(1)
        else:
            control.release()


def test_control_is_in_the_store_before_it_is_confirmed(tmp_path):
    """A file store loses the last milliseconds of an ASYNC session with its server, but no take-over or return."""
    store = f"--session_store=file:{tmp_path}/sessions"
    with restartable_server(store) as server, operating(server.address) as (client, operator):
        for _ in range(3):
            session = client.open_session("cartpole", spikeserve.SessionOptions(durability="ASYNC"))
            for is_taken in (True, False):
                control = operator.take(session.session_id, lease=60.0)
                if not is_taken:
                    control.release()
                server.kill()
                server.start()
                assert (session.act(OBSERVATION, 1.0, timeout=60.0).source == "OPERATOR") == is_taken
                if is_taken:
                    control.release()


def test_the_commands(server):
    session = server.agent.OpenSession(policy="cartpole", labels={"site": "east"}).session_id

    def act(step):
        return server.agent.Act(session_id=session, step=step, observation=OBSERVATION)

    act(0)
    held = server.spikectl("hold", "--label=site=east", "--id=fire", "--reason=smoke", "--wait=0s", "--json", status=1)
    verdict = json.loads(held.stdout)
    assert (verdict["id"], verdict["not_confirmed"]) == ("fire", 1)
    assert verdict["robots"][0]["session_id"] == session
    act(1), act(2)
    shown = server.spikectl("hold", "--label=site=east", "--id=fire").stdout
    assert "fire: 1 of 1 robots at their neutral action\n" in shown
    assert "fire: label site=east; 1 sessions" in server.spikectl("holds").stdout
    assert server.spikectl("resume", "--id=fire").stdout == "resumed fire: label site=east\n"
    assert server.spikectl("holds").stdout == "no holds\n"

    here, there = pty.openpty()
    command = [os.environ["SPIKECTL_PROGRAM"], "take", f"--session={session}", "--operator=ann", f"--server={server.grpc}"]
    with subprocess.Popen(command, stdin=there, stdout=subprocess.PIPE, text=True) as taking:
        assert "ann has control; keys 0 to 1" in taking.stdout.readline()
        step, answers = 3, []
        for key in ("1", "0"):
            os.write(here, key.encode())

            def is_heard(key=key):
                nonlocal step
                answers.append(act(step))
                step += 1
                return answers[-1].action.discrete == int(key)

            until(is_heard)
        assert {answer.source.operator_id for answer in answers} == {"ann"}

        since = time.monotonic()

        def has_lasted():
            """Presses keys without a meaning, for longer than the lease."""
            nonlocal step
            os.write(here, b"x")
            assert act(step).source.operator_id == "ann"
            step += 1
            return time.monotonic() - since > 1.5

        until(has_lasted)
        os.write(here, b"\x03")  # Ctrl-C
        assert "returned after" in taking.stdout.read()
        assert taking.wait() == 0
    os.close(here)
    os.close(there)
    assert not act(step).HasField("source")


@pytest.mark.parametrize("last", ["\x1b", "q"])
def test_keys_of_several_bytes_have_no_meaning(server, last):
    """A sequence of an arrow, F9 or Alt with a key, and the digit in it. The end of the input returns the session, too."""
    session = server.agent.OpenSession(policy="cartpole").session_id
    server.agent.Act(session_id=session, observation=OBSERVATION)
    keys = ("1", "\x1b[A", "\x1b[20~", "\x1b\x1b[20~", "\x1bOC", "\x1b0", "x")
    _, *steered, returned = server.spikectl(
        "take", f"--session={session}", "--operator=ann", input="".join(keys) + last
    ).stdout.splitlines()
    assert [": 1; the policy agreed" in line for line in steered] == [True] * (len(keys) + (last != "q"))
    assert returned.startswith("returned after ")


def test_who_needs_help(server):
    """Each session has one reason, which is measured, and the list begins with the one that has most of it."""
    usual, act = [1.0, 0.0, 0.0], server.agent.Act
    calm, strange, poor, missed = (server.agent.OpenSession(policy="pendulum", period_seconds=1.0).session_id for _ in range(4))
    unsure = server.agent.OpenSession(policy="cartpole").session_id
    for step in range(4):
        act(session_id=calm, step=step, observation=usual)
        act(session_id=strange, step=step, observation=[50.0, 0.0, 0.0] if step else usual)
        act(session_id=poor, step=step, observation=usual, reward=-200.0)
        answer = act(session_id=unsure, step=step, observation=OBSERVATION)
    act(session_id=missed, step=0, observation=usual, report={"fresh": 4, "held": 1, "local": 1})
    act(session_id=missed, step=1, observation=usual, report={"fresh": 5, "held": 3, "local": 1, "safe": 1})

    def listed(**fields):
        return {session.session_id: session.needs_help for session in server.admin.ListSessions(by_need=True, **fields).sessions}

    needs = listed(policy="pendulum")
    assert calm not in needs
    assert needs[strange].unusual_observations == pytest.approx(3 / 4)
    assert needs[poor].low_return == pytest.approx(470 / 1000)  # of the range, for a target of -130
    assert needs[missed].fallbacks == pytest.approx(3 / 4)  # of what the second report adds
    for id in (strange, poor, missed):
        assert needs[id].score == pytest.approx(sum(getattr(needs[id], part) for part in PARTS))
    scores = [need.score for need in needs.values()]
    assert scores == sorted(scores, reverse=True)
    assert list(listed(policy="pendulum", page_size=1)) == list(needs)[:1]
    assert 0.0 < listed(policy="cartpole")[unsure].entropy <= 1.0
    assert len(answer.action_probabilities) == 2
    server.agent.EndEpisode(session_id=unsure, terminated=True)
    assert listed(policy="cartpole")[unsure].low_return == pytest.approx(1.0)  # nothing of a target of 500
    # Expected are the 500 of the policy's evaluation, if the target is more, or what the session returned before.
    for target, returns, lacking in ((1000.0, [450.0], 50.0), (10.0, [400.0, 300.0], 100.0)):
        session = server.agent.OpenSession(policy="cartpole", target_return=target).session_id
        for reward in returns:
            act(session_id=session, step=0, observation=OBSERVATION)
            server.agent.EndEpisode(session_id=session, reward=reward, terminated=True)
        assert listed(policy="cartpole")[session].low_return == pytest.approx(lacking / 500)
    with fails_with(INVALID, "page_token: expected none with by_need"):
        listed(page_token=calm)

    lines = server.spikectl("admin", "sessions", "--by_need", "--policy=pendulum").stdout.splitlines()
    assert [line.split()[0] for line in lines[1:] if line[0] != " "] == list(needs)
    assert max(map(len, lines)) <= 100
    page = http_call(server.http, "GET", "/sessions.json?filter=pendulum&sort=needs_help&order=descending")[2]
    rows = [row["session_id"] for row in json.loads(page)["sessions"] if row["needs_help"]]
    assert rows == list(needs)


def test_corrections_are_shown(server):
    learning = spikeserve.SessionOptions(learning=spikeserve.Learning(rule="corrections"))
    with operating(server.grpc) as (client, operator), client.open_session("cartpole", learning) as session:
        action = session.act(OBSERVATION).action
        with operator.take(session.session_id, lease=60.0, action=1 - action):
            for _ in range(3):
                session.act(OBSERVATION, 1.0)
        known = session.state().corrections
        shown = {each.session_id: each for each in server.admin.ListSessions(policy="cartpole").sessions}[session.session_id]
        assert (shown.corrections.steps, known.steps) == (3, 3)
        assert shown.corrections.disagreement == known.disagreement < known.start_disagreement
        lines = server.spikectl("admin", "sessions", "--policy=cartpole").stdout.splitlines()
        [line] = [lines[i + 1] for i, text in enumerate(lines) if text.startswith(session.session_id)]
        assert line.startswith("  3 steps of operators; apart from them: 0.") and line.endswith(" at the start")


def test_the_seat_of_the_status_page(tokens):
    """The page's calls have the rights, the audit and the refusals of those of gRPC, and no other site makes them."""
    with running_server(flags=[f"--tokens={tokens}"]) as server, service_with(server, "agent") as agent:
        session = agent.OpenSession(policy="cartpole").session_id
        agent.Act(session_id=session, observation=OBSERVATION)

        def post(path, fields, token="nina", **headers):
            headers = {"Content_Type": "application/json"} | headers
            code, _, body = http_call(server.http, "POST", f"/{path}.json", json.dumps(fields), token, **headers)
            return code, json.loads(body)

        wanted = {"session_id": session, "lease_seconds": 60}
        for token, code in (("agent", 403), ("viewer", 403), ("rival-operator", 404), ("nonsense", 401)):
            assert post("take", wanted | {"operator_id": "eve"}, token)[0] == code
        own = f"http://{server.http}"
        for origin in ("http://evil.example", own.replace(":", "s:", 1) + "0", f"{own}.evil.example", "null"):
            code, error = post("take", wanted, Origin=origin)
            assert code == 403 and error["error"].startswith("Origin: expected none, that of this server"), origin
            assert post("undo", wanted, Origin=origin)[0] == 403
        assert post("undo", wanted, "viewer")[0] == 403
        assert post("take", wanted, Content_Type="text/plain")[0] == 415
        assert http_call(server.http, "GET", "/take.json", token="nina")[0] == 405
        assert post("take", wanted | {"lease_seconds": "long"})[1]["message"].startswith("body: ")
        assert agent.Act(session_id=session, step=1, observation=OBSERVATION).source.operator_id == ""

        code, taken = post("take", wanted, Origin=own)
        assert (code, taken["operator_id"], taken["action_space"]) == (200, "nina", {"discrete": {"n": "2"}})
        lease = {"session_id": session, "lease_id": taken["lease_id"]}
        for step, action in enumerate((1, 0, 1), 2):
            assert post("steer", lease | {"action": {"discrete": action}}, Origin=own)[0] == 200
            answer = agent.Act(session_id=session, step=step, observation=OBSERVATION)
            assert (answer.source.operator_id, answer.action.discrete) == ("nina", action)
        code, error = post("take", wanted | {"operator_id": "bob"}, "operator")
        assert (code, error["code"]) == (409, "FAILED_PRECONDITION") and '"nina"' in error["message"]
        assert series(server, "spikeserve_seats", "viewer") == [1]
        assert post("return", lease)[1]["steps"] == "3"
        assert series(server, "spikeserve_seats", "viewer") == [0]
        changes = {change: series(server, "spikeserve_seat_changes_total", "viewer", change=change) for change in ("taken", "taken_over", "returned")}
        assert changes == {"taken": [1], "taken_over": [0], "returned": [1]}
        with service_with(server, "viewer", ADMIN) as admin:
            assert [(each.action, each.token) for each in admin.ListHistory().entries][:2] == [("ReturnControl", "nina"), ("TakeControl", "")]


def test_a_name_that_anybody_may_have_opens_no_seat():
    """Without tokens, a page whose site resolves to this server may not steer, though its origin is that of the request."""
    with running_server(flags=["--http_listen=0.0.0.0:0", "--insecure_network"]) as server:
        port = server.http.rpartition(":")[2]
        for name, code in ((f"evil.example:{port}", 403), (f"10.0.0.7:{port}", 404), (f"localhost:{port}", 404)):
            headers = {"Content_Type": "application/json", "Host": name, "Origin": f"http://{name}"}
            assert http_call(f"127.0.0.1:{port}", "POST", "/take.json", '{"session_id": "x", "operator_id": "eve"}', **headers)[0] == code
