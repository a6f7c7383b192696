"""A tenant can neither see nor use the sessions of another tenant."""

import json

import grpc
from security import ADMIN, OBSERVATION, Bearer, code_of, service_with
from serving import DEADLINE_SECONDS, http_call, method_of, page_of


def test_another_tenants_session_is_not_found(addresses):
    with service_with(addresses, "agent") as ours, service_with(addresses, "rival") as theirs:
        session = ours.OpenSession(policy="cartpole").session_id
        not_found = grpc.StatusCode.NOT_FOUND
        for call in (theirs.Act, theirs.GetSession, theirs.EndEpisode, theirs.CloseSession):
            assert code_of(call, session_id=session) == not_found
        assert code_of(theirs.Explain, session_id=session) == not_found
        assert ours.Act(session_id=session, observation=OBSERVATION).step == 0


def test_looking_stops_at_the_tenant_unless_the_token_sees_all(addresses):
    with service_with(addresses, "agent") as ours:
        session = ours.OpenSession(policy="cartpole").session_id
        ours.Act(session_id=session, observation=OBSERVATION)

    def seen_by(token):
        with service_with(addresses, token) as policies:
            looks = [
                code_of(policies.GetSession, session_id=session),
                code_of(policies.Explain, session_id=session),
            ]
        explained = http_call(addresses.http, "GET", f"/explain.json?session={session}", token=token)[0]
        with service_with(addresses, token, ADMIN) as admin:
            listed = admin.ListSessions(page_size=1000)
        page = json.loads(page_of(addresses, "/sessions.json?page_size=1000", token))
        assert listed.open_sessions == len(listed.sessions) == page["open"] == page["matching"]
        for ids in (
            [entry.session_id for entry in listed.sessions],
            [entry["session_id"] for entry in page["sessions"]],
        ):
            assert (session in ids) == (explained == 200)
        return looks, explained

    ok, not_found = grpc.StatusCode.OK, grpc.StatusCode.NOT_FOUND
    for token in ("viewer", "operator", "watchman", "machine"):
        assert seen_by(token) == ([ok, ok], 200), token
    for token in ("rival-viewer", "rival-operator"):
        assert seen_by(token) == ([not_found, not_found], 404), token
    query = "/sessions.json?page_size=1000&filter=tenant%3Drival"
    with service_with(addresses, "rival") as theirs:
        theirs.OpenSession(policy="cartpole")
    rivals = json.loads(page_of(addresses, query, "watchman"))["sessions"]
    assert {entry["tenant"] for entry in rivals} == {"rival"}
    # A token that sees a session cannot use it.
    with service_with(addresses, "rival-operator") as other:
        assert code_of(other.CloseSession, session_id=session) == not_found
        assert code_of(other.Act, session_id=session, observation=OBSERVATION) == not_found


def test_tenants_may_use_equal_sequence_ids(addresses):
    def start(token):
        calls = grpc.intercept_channel(addresses.channel, Bearer(token))
        request_class, call = method_of(addresses.channel, "inference.GRPCInferenceService", "ModelInfer", calls)
        request = request_class(model_name="cartpole")
        request.parameters["sequence_id"].int64_param = 7
        request.parameters["sequence_start"].bool_param = True
        tensor = request.inputs.add(name="observation", datatype="FP32", shape=[4])
        tensor.contents.fp32_contents.extend(OBSERVATION)
        return code_of(call, request=request, timeout=DEADLINE_SECONDS)

    for token in ("agent", "rival", "agent"):
        assert start(token) == grpc.StatusCode.OK, token


def test_an_id_of_another_tenant_opens_as_any_other(addresses):
    """Neither tenant learns from OpenSession that the other has a session of an id; each has its own."""
    foreign, unknown = "a" * 32, "b" * 32
    with service_with(addresses, "agent") as ours, service_with(addresses, "rival") as theirs:
        ours.OpenSession(policy="cartpole", session_id=foreign)
        answers = [theirs.OpenSession(policy="cartpole", session_id=name) for name in (foreign, unknown)]
        assert [answer.session_id for answer in answers] == [foreign, unknown]
        answers[0].session_id = unknown
        assert answers[0] == answers[1]
        # A request that is sent again gets the session that it has opened.
        assert theirs.OpenSession(policy="cartpole", session_id=foreign).session_id == foreign
        for step in range(3):
            assert theirs.Act(session_id=foreign, step=step, observation=OBSERVATION).step == step
        assert theirs.GetSession(session_id=foreign).step == 3
        assert ours.GetSession(session_id=foreign).step == 0
        assert ours.Act(session_id=foreign, observation=OBSERVATION).step == 0
        theirs.CloseSession(session_id=foreign)
        assert code_of(theirs.GetSession, session_id=foreign) == grpc.StatusCode.NOT_FOUND
        assert ours.GetSession(session_id=foreign).step == 1
        ours.CloseSession(session_id=foreign)
