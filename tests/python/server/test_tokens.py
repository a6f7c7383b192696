"""The token and its role decide which calls are allowed."""

import base64
import json
import threading

import grpc
import pytest
from security import (
    ADMIN,
    HEALTH,
    OBSERVATION,
    POLICY,
    SERVING,
    TOKENS,
    code_of,
    entry,
    service_with,
    until,
)
from serving import DEADLINE_SECONDS, Service, http_call, method_of, refusal_at_start, running_server


@pytest.mark.parametrize("token", [None, "wrong", "expired"])
def test_a_token_that_is_missing_wrong_or_expired_is_unauthenticated(addresses, token):
    with service_with(addresses, token) as policies, service_with(addresses, token, ADMIN) as admin:
        for call in (policies.ListPolicies, policies.OpenSession, policies.Act, admin.Drain):
            assert code_of(call) == grpc.StatusCode.UNAUTHENTICATED


def test_a_stream_without_a_token_ends_unauthenticated(addresses):
    stream = addresses.channel.stream_stream(f"/{POLICY}/ActStream")(iter([]), timeout=DEADLINE_SECONDS)
    assert stream.code() == grpc.StatusCode.UNAUTHENTICATED


def test_a_token_that_is_taken_back_ends_what_its_streams_may_do(tmp_path):
    path = tmp_path / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    taken_back = threading.Event()
    with (
        running_server(flags=[f"--tokens={path}"]) as addresses,
        service_with(addresses, "agent") as policies,
    ):
        session = policies.OpenSession(policy="cartpole").session_id
        request_class, call = method_of(addresses.channel, POLICY, "ActStream")

        def requests():
            yield request_class(session_id=session, step=0, observation=OBSERVATION)
            assert taken_back.wait(DEADLINE_SECONDS)
            yield request_class(session_id=session, step=1, observation=OBSERVATION)

        stream = call(requests(), metadata=[("authorization", "Bearer agent")], timeout=DEADLINE_SECONDS)
        assert next(stream).step == 0
        path.write_text(json.dumps({**TOKENS, "tokens": [entry("operator", "operator")]}))
        until(lambda: code_of(policies.ListPolicies) == grpc.StatusCode.UNAUTHENTICATED)
        taken_back.set()
        answer = next(stream)
        assert answer.error.code == grpc.StatusCode.UNAUTHENTICATED.value[0]
        assert not answer.HasField("action")


def test_health_needs_no_token(addresses):
    assert Service(addresses.channel, HEALTH).Check().status == SERVING


def test_roles_decide_what_may_be_called(addresses):
    denied = grpc.StatusCode.PERMISSION_DENIED
    with service_with(addresses, "agent", ADMIN) as admin:
        assert code_of(admin.ListSessions) == code_of(admin.Drain) == denied
    with service_with(addresses, "viewer", ADMIN) as admin:
        assert code_of(admin.ListSessions) == grpc.StatusCode.OK
        assert code_of(admin.Drain) == code_of(admin.ReloadPolicies) == denied
    with service_with(addresses, "viewer") as policies:
        assert code_of(policies.ListPolicies) == grpc.StatusCode.OK
        assert code_of(policies.OpenSession, policy="cartpole") == denied
    with service_with(addresses, "operator", ADMIN) as admin:
        assert code_of(admin.ReloadPolicies) == grpc.StatusCode.OK
        assert {session.tenant for session in admin.ListSessions().sessions} <= {"fleet"}


PAGES = ("/", "/main.js", "/metrics", "/status.json", "/sessions.json")


@pytest.mark.parametrize("path", [*PAGES, "/explain.json?session=nobody", "/nothing"])
def test_the_status_page_is_for_viewers_and_operators(addresses, path):
    found = 200 if path in PAGES else 404

    def code(**headers):
        return http_call(addresses.http, "GET", path, **headers)[0]

    assert code() == 401
    for token in ("wrong", "expired"):
        assert code(token=token) == 401
    for token in ("agent", "rival", "small"):
        assert code(token=token) == 403
    for token in ("viewer", "operator", "rival-viewer", "watchman", "machine"):
        assert code(token=token) == found
    browser = base64.b64encode(b"anyone:operator").decode()
    assert code(Authorization=f"Basic {browser}") == found
    assert code(Authorization="bearer operator") == found
    assert code(Authorization="operator") == 401


def tokens_of(*entries):
    return {"tenants": {"fleet": {}}, "tokens": list(entries)}


MISTAKES = [
    ({"token": []}, '"token"'),
    (tokens_of({"sha256": "00", "tenant": "fleet", "role": "agent"}), "tokens[0].sha256"),
    (tokens_of(entry("a", "king")), "expected agent, viewer or operator"),
    (tokens_of(entry("a", "agent"), entry("a", "agent")), "tokens[1].sha256"),
    (tokens_of(entry("a", "agent", expires="soon")), "tokens[0].expires"),
    (tokens_of(entry("v", "viewer", sees="everything")), "tokens[0].sees"),
    (tokens_of(entry("a", "agent", sees="all")), "tokens[0].sees: expected tenant"),
    (tokens_of(entry("a", "agent", "nobody")), "tokens[0].tenant"),
    ({"tenants": {"fleet": {"max_sessions": -1}}}, "tenants.fleet.max_sessions"),
    ({"tenants": {"fleet": {"max_sessions": "many"}}}, "expected an integer"),
    ({"tenants": {"fleet": {"calls_per_second": {"slow": 1}}}}, "tenants.fleet.calls_per_second: "),
]


@pytest.mark.parametrize(("text", "message"), MISTAKES)
def test_a_mistake_in_the_file_keeps_the_server_from_starting(tmp_path, text, message):
    path = tmp_path / "tokens.json"
    path.write_text(json.dumps(text))
    assert message in refusal_at_start(f"--tokens={path}")


def test_load_balancers_need_no_token(addresses):
    assert http_call(addresses.http, "GET", "/healthz")[0] == 200


def test_a_changed_file_takes_effect_and_a_broken_one_does_not(tmp_path):
    path = tmp_path / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    with (
        running_server(flags=[f"--tokens={path}"]) as addresses,
        service_with(addresses, "agent") as old,
        service_with(addresses, "new") as new,
    ):
        session = old.OpenSession(policy="cartpole").session_id
        path.write_text("{")
        changed = {**TOKENS, "tokens": [entry("new", "agent")]}
        assert code_of(new.ListPolicies) == grpc.StatusCode.UNAUTHENTICATED
        path.write_text(json.dumps(changed))
        until(lambda: code_of(new.ListPolicies) == grpc.StatusCode.OK)
        assert code_of(old.ListPolicies) == grpc.StatusCode.UNAUTHENTICATED
        # The sessions of the tenant stay usable with the new token.
        assert new.Act(session_id=session, observation=OBSERVATION).step == 0
