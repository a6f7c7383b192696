"""Sessions survive their server: after kill -9 they continue, and decide what they would have decided without it."""

import json
import secrets
import shutil

import grpc
import pytest
from security import OBSERVATION, POLICY, TOKENS, code_of, fails_with, service_with, until
from serving import SHIPPED_POLICIES, method_of
from stored_sessions import (
    DEADLINE_SECONDS,
    Restartable,
    acting,
    comparable,
    ending,
    expected_decision,
    opening,
    play,
    undisturbed_play,
)


@pytest.fixture
def server(tmp_path):
    with Restartable(f"file:{tmp_path}/store") as started:
        yield started


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_play()


def test_killed_between_decisions(server, undisturbed):
    """The server is killed in the first episodes, at a snapshot, between episodes and in the second episodes."""
    kills = {(0, 1), (0, 16), (0, 29), (1, 0), (1, 20)}

    def disturb(episode, step):
        if (episode, step) in kills:
            server.restart()

    assert play(lambda: server, disturb) == undisturbed


def test_killed_while_it_decides(server, undisturbed):
    """A batch that was under way when the server was killed is sent again. Each decision is made once."""

    def batch(requests):
        if requests[0]["step"] % 13 != 5:
            return server.ActBatch(requests=requests)
        request_class, call = method_of(server.channel, POLICY, "ActBatch")
        under_way = call.future(request_class(requests=requests), timeout=DEADLINE_SECONDS)
        server.restart()
        under_way.cancel()
        return server.ActBatch(requests=requests)

    assert play(lambda: server, batch=batch) == undisturbed


def test_asynchronous_sessions_ask_for_what_was_lost(server):
    """The client sends again what the store does not have, and gets the same answers."""
    session = secrets.token_hex(16)
    server.OpenSession(session_id=session, policy="cartpole", seed=5, durability="ASYNC")
    requests = [acting(0, 0, step) | {"session_id": session} for step in range(200)]
    answers = [server.Act(**request) for request in requests]
    durable = answers[-1].durable_decision
    server.restart()
    with fails_with(grpc.StatusCode.FAILED_PRECONDITION) as error:
        server.Act(**acting(0, 0, 201) | {"session_id": session, "decision": 201})
    expected = expected_decision(server.channel, error.value)
    assert durable <= expected <= 200
    for step in range(expected, 200):
        assert comparable(server.Act(**requests[step])) == comparable(answers[step])
    assert server.GetSession(session_id=session).decisions == 200


def test_everything_of_a_sync_session_is_durable_when_it_is_answered(server):
    session = server.OpenSession(policy="cartpole", durability="SYNC").session_id
    for step in range(40):
        answer = server.Act(**acting(0, 0, step) | {"session_id": session})
        assert answer.durable_decision == step + 1


def test_opening_is_idempotent(server):
    first = server.OpenSession(**opening(5)).SerializeToString()
    assert server.OpenSession(**opening(5)).SerializeToString() == first
    server.restart()
    assert server.OpenSession(**opening(5)).SerializeToString() == first
    assert code_of(server.OpenSession, **opening(5) | {"seed": 6}) == grpc.StatusCode.ALREADY_EXISTS


def test_a_session_over_the_limit_is_refused_at_once(tmp_path):
    """A session that was not opened is never written, so its refusal waits for nothing."""
    with Restartable(f"file:{tmp_path}/store", flags=["--max_sessions=1"]) as full:
        for durability in ("ASYNC", "SYNC"):
            full.OpenSession(**opening(0))
            refused = code_of(full.OpenSession, policy="cartpole", durability=durability)
            assert refused == grpc.StatusCode.RESOURCE_EXHAUSTED


def test_a_closed_session_stays_closed(server):
    session = server.OpenSession(policy="cartpole", durability="SYNC").session_id
    server.restart()
    server.CloseSession(session_id=session)
    server.restart()
    assert code_of(server.GetSession, session_id=session) == grpc.StatusCode.NOT_FOUND


def test_levels(server):
    def level(**fields):
        return server.OpenSession(policy="cartpole", **fields).durability

    none, asynchronous, sync = 1, 2, 3
    sampled = {"action_selection": "SAMPLE"}
    assert level() == asynchronous
    assert level(durability="NONE") == none
    assert level(learning={}, **sampled) == sync
    assert level(learning={}, durability="ASYNC", **sampled) == asynchronous
    assert level(learning={"scope": "FLEET"}, durability="NONE", **sampled) == sync
    session = server.OpenSession(policy="cartpole", durability="NONE").session_id
    server.restart()
    assert code_of(server.GetSession, session_id=session) == grpc.StatusCode.NOT_FOUND


def test_the_ceiling_of_a_tenant(tmp_path):
    """A tenant gets no higher durability than its max_durability, which may change while the server runs."""
    file = tmp_path / "tokens.json"
    none, asynchronous, sync = 1, 2, 3

    def write(ceiling):
        tenants = {"fleet": {"max_durability": ceiling}, "rival": {}}
        file.write_text(json.dumps({"tenants": tenants, "tokens": TOKENS["tokens"][:3]}))

    write("async")
    learning = {"action_selection": "SAMPLE", "learning": {}}
    fleet = {"action_selection": "SAMPLE", "learning": {"scope": "FLEET"}}
    with Restartable(f"file:{tmp_path}/store", flags=[f"--tokens={file}", "--durability=sync"]) as server:
        with service_with(server.addresses, "agent") as service:

            def level(**fields):
                return service.OpenSession(policy="cartpole", **fields).durability

            assert [level(), level(**learning), level(durability="ASYNC")] == [asynchronous] * 3
            assert level(durability="NONE") == none
            for fields, why in (({"durability": "SYNC"}, ""), (fleet, ", which learning.scope FLEET needs")):
                with fails_with(grpc.StatusCode.PERMISSION_DENIED) as error:
                    level(**fields)
                assert error.value.details() == (
                    "durability: expected at most ASYNC, the max_durability of tenant fleet, received SYNC" + why
                )
            write("none")
            until(lambda: level() == none)
            denied = grpc.StatusCode.PERMISSION_DENIED
            assert code_of(service.OpenSession, policy="cartpole", durability="ASYNC") == denied
            write("sync")
            until(lambda: level() == sync)


def test_episodes_are_ended_once(server):
    server.OpenSession(**opening(0))
    for step in range(3):
        server.Act(**acting(0, 0, step))
    for wrong, message in [
        ({"episode": 1, "steps": 3}, "episode: expected 0, received 1"),
        ({"episode": 0, "steps": 2}, "steps: expected 3, received 2"),
    ]:
        with fails_with(grpc.StatusCode.FAILED_PRECONDITION, whole=message) as error:
            server.EndEpisode(**ending(0, 0) | wrong)
        assert expected_decision(server.channel, error.value) == 3
    ended = server.EndEpisode(**ending(0, 0) | {"steps": 3}).SerializeToString()
    server.restart()
    assert server.EndEpisode(**ending(0, 0) | {"steps": 3}).SerializeToString() == ended
    server.Act(**acting(0, 0, 0) | {"decision": 3})
    # The late repetition of the first end must not end the second episode.
    assert code_of(server.EndEpisode, **ending(0, 0) | {"steps": 3}) == grpc.StatusCode.FAILED_PRECONDITION


def test_step_5_of_another_episode_is_not_taken_for_this_one(server):
    server.OpenSession(**opening(0))
    for step in range(2):
        server.Act(**acting(0, 0, step))
    with pytest.raises(grpc.RpcError) as error:
        server.Act(**acting(0, 0, 1) | {"decision": 7})
    assert error.value.details() == "decision: expected 2, received 7"
    response = server.ActBatch(requests=[acting(0, 0, 2) | {"decision": 9}])
    assert response.results[0].code == grpc.StatusCode.FAILED_PRECONDITION.value[0]
    assert response.results[0].expected_decision == 2


def test_a_stream_goes_on_after_a_restart(server):
    server.OpenSession(**opening(2))

    def stream(steps):
        request_class, call = method_of(server.channel, POLICY, "ActStream")
        requests = (request_class(**acting(2, 0, step)) for step in steps)
        return [(answer.step, answer.error.code) for answer in call(requests, timeout=DEADLINE_SECONDS)]

    assert stream(range(3)) == [(0, 0), (1, 0), (2, 0)]
    server.restart()
    assert stream([2]) == [(2, 0)]
    server.restart()
    assert stream([3]) == [(3, 0)]


def test_a_session_waits_for_its_policy(tmp_path):
    """A server that has other weights for the version of a session does not decide for it."""
    policies = tmp_path / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole", policies / "cartpole")
    with Restartable(f"file:{tmp_path}/store", policies=policies) as server:
        server.OpenSession(**opening(0))
        first = comparable(server.Act(**acting(0, 0, 0)))
        file = policies / "cartpole" / "1" / "policy.safetensors"
        kept = file.read_bytes()
        file.write_bytes((policies / "cartpole" / "2" / "policy.safetensors").read_bytes())
        server.restart()
        with fails_with(grpc.StatusCode.UNAVAILABLE, "whose file is another one here"):
            server.Act(**acting(0, 0, 1))
        file.write_bytes(kept)
        server.restart()
        assert comparable(server.Act(**acting(0, 0, 0))) == first


def test_other_tenants_do_not_get_the_session(tmp_path, tokens):
    with Restartable(f"file:{tmp_path}/store", flags=[f"--tokens={tokens}"]) as server:
        with service_with(server.addresses, "agent") as ours:
            session = ours.OpenSession(policy="cartpole", durability="SYNC").session_id
            ours.Act(session_id=session, observation=OBSERVATION)
        server.restart()
        not_found = grpc.StatusCode.NOT_FOUND
        with service_with(server.addresses, "rival") as theirs:
            for call in (theirs.Act, theirs.GetSession, theirs.EndEpisode, theirs.CloseSession):
                assert code_of(call, session_id=session) == not_found
        with service_with(server.addresses, "agent") as ours:
            assert ours.GetSession(session_id=session).decisions == 1


def test_without_a_store(service):
    message = "durability: expected NONE, because the server runs without --session_store, received SYNC"
    with fails_with(grpc.StatusCode.INVALID_ARGUMENT, whole=message):
        service.OpenSession(policy="cartpole", durability="SYNC")
    assert code_of(service.OpenSession, policy="cartpole", session_id="7") == grpc.StatusCode.INVALID_ARGUMENT
    opened = service.OpenSession(policy="cartpole", session_id="7" * 32)
    assert (opened.session_id, opened.durability) == ("7" * 32, 1)
    answer = service.Act(session_id="7" * 32, observation=[0.0] * 4)
    assert answer.durable_decision == 0
