"""Who may do what: TLS, tokens, tenants and limits, through real processes."""

import base64
import contextlib
import hashlib
import http.client
import json
import os
import ssl
import subprocess
import time
import urllib.error
import urllib.request

import grpc
import pytest
from serving import DEADLINE_SECONDS, Service, message_class, running_server

POLICY = "spikeserve.v1.PolicyService"
ADMIN = "spikeserve.v1.PolicyAdmin"
HEALTH = "grpc.health.v1.Health"
SERVING = 1
OBSERVATION = [0.01, -0.02, 0.03, 0.1]


def entry(token, role, tenant="fleet", **more):
    """A token as the file holds it."""
    digest = hashlib.sha256(token.encode()).hexdigest()
    return {"sha256": digest, "tenant": tenant, "role": role, **more}


TOKENS = {
    "tenants": {
        "fleet": {},
        "rival": {},
        "slow": {"decisions_per_second": 5},
        "small": {"max_sessions": 2, "decisions_per_second": 5, "max_message_bytes": 200},
    },
    "tokens": [
        entry("agent", "agent"),
        entry("viewer", "viewer"),
        entry("operator", "operator"),
        entry("watchman", "viewer", sees="all"),
        entry("machine", "operator", sees="all"),
        entry("rival", "agent", "rival"),
        entry("rival-viewer", "viewer", "rival", sees="tenant"),
        entry("rival-operator", "operator", "rival"),
        entry("small", "agent", "small"),
        entry("slow", "agent", "slow"),
        entry("expired", "agent", expires="2001-01-01T00:00:00Z"),
    ],
}


class Bearer(grpc.UnaryUnaryClientInterceptor):
    """Adds a token to every call."""

    def __init__(self, token):
        self._metadata = (("authorization", f"Bearer {token}"),)

    def intercept_unary_unary(self, continuation, client_call_details, request):
        return continuation(client_call_details._replace(metadata=self._metadata), request)


@pytest.fixture(scope="module")
def tokens(tmp_path_factory):
    path = tmp_path_factory.mktemp("tokens") / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    return path


@pytest.fixture(scope="module")
def addresses(tokens):
    with running_server(flags=[f"--tokens={tokens}"]) as started:
        yield started


@contextlib.contextmanager
def service_with(addresses, token, name=POLICY):
    with grpc.insecure_channel(addresses.grpc) as channel:
        described = Service(channel, name)  # reflection needs no token
        if token is not None:
            described = Service(channel, name, grpc.intercept_channel(channel, Bearer(token)))
        yield described


def code_of(call, **fields):
    try:
        call(**fields)
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


@pytest.mark.parametrize("token", [None, "wrong", "expired"])
def test_a_token_that_is_missing_wrong_or_expired_is_unauthenticated(addresses, token):
    with service_with(addresses, token) as policies, service_with(addresses, token, ADMIN) as admin:
        for call in (policies.ListPolicies, policies.OpenSession, policies.Act, admin.Drain):
            assert code_of(call) == grpc.StatusCode.UNAUTHENTICATED


def test_a_stream_without_a_token_ends_unauthenticated(addresses):
    with grpc.insecure_channel(addresses.grpc) as channel:
        stream = channel.stream_stream(f"/{POLICY}/ActStream")(iter([]), timeout=DEADLINE_SECONDS)
        assert stream.code() == grpc.StatusCode.UNAUTHENTICATED


def test_health_needs_no_token(addresses):
    with grpc.insecure_channel(addresses.grpc) as channel:
        assert Service(channel, HEALTH).Check().status == SERVING


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
        explained = http_code(addresses.http, f"/explain.json?session={session}", f"Bearer {token}")
        with service_with(addresses, token, ADMIN) as admin:
            listed = admin.ListSessions(page_size=1000)
        page = json.loads(http_body(addresses.http, "/sessions.json?limit=1000", f"Bearer {token}"))
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
    query = "/sessions.json?limit=1000&filter=tenant%3Drival"
    with service_with(addresses, "rival") as theirs:
        theirs.OpenSession(policy="cartpole")
    rivals = json.loads(http_body(addresses.http, query, "Bearer watchman"))["sessions"]
    assert {entry["tenant"] for entry in rivals} == {"rival"}
    # To look is not to touch.
    with service_with(addresses, "rival-operator") as other:
        assert code_of(other.CloseSession, session_id=session) == not_found
        assert code_of(other.Act, session_id=session, observation=OBSERVATION) == not_found


def test_tenants_may_use_equal_sequence_ids(addresses):
    def start(token):
        with grpc.insecure_channel(addresses.grpc) as channel:
            request = message_class(channel, "inference.ModelInferRequest")(model_name="cartpole")
            request.parameters["sequence_id"].int64_param = 7
            request.parameters["sequence_start"].bool_param = True
            tensor = request.inputs.add(name="observation", datatype="FP32", shape=[4])
            tensor.contents.fp32_contents.extend(OBSERVATION)
            calls = grpc.intercept_channel(channel, Bearer(token))
            call = calls.unary_unary(
                "/inference.GRPCInferenceService/ModelInfer",
                request_serializer=type(request).SerializeToString,
                response_deserializer=message_class(channel, "inference.ModelInferResponse").FromString,
            )
            return code_of(call, request=request, timeout=DEADLINE_SECONDS)

    for token in ("agent", "rival", "agent"):
        assert start(token) == grpc.StatusCode.OK, token


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


def retry_delay(addresses, error):
    """Seconds of google.rpc.RetryInfo among the details of a refused call."""
    trailers = {entry.key: entry.value for entry in error.trailing_metadata()}
    with grpc.insecure_channel(addresses.grpc) as channel:
        status = message_class(channel, "google.rpc.Status")
        info = message_class(channel, "google.rpc.RetryInfo")()
        (detail,) = status.FromString(trailers["grpc-status-details-bin"]).details
    assert detail.Unpack(info), detail
    return info.retry_delay.seconds + info.retry_delay.nanos * 1e-9


def test_a_flood_and_too_many_sessions_are_resource_exhausted(addresses):
    with service_with(addresses, "small") as small, service_with(addresses, "agent") as other:
        sessions = [small.OpenSession(policy="cartpole").session_id for _ in range(2)]
        assert code_of(small.OpenSession, policy="cartpole") == grpc.StatusCode.RESOURCE_EXHAUSTED
        small.CloseSession(session_id=sessions.pop())
        sessions.append(small.OpenSession(policy="cartpole").session_id)

        neighbour = other.OpenSession(policy="cartpole").session_id
        refused = None
        for step in range(1000):
            other.Act(session_id=neighbour, step=step, observation=OBSERVATION)
            try:  # retries of one step: they cost the server a call each, so they count
                small.Act(session_id=sessions[0], step=0, observation=OBSERVATION)
            except grpc.RpcError as error:
                refused = error
                break
        assert refused.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert 0 < retry_delay(addresses, refused) <= 0.2
        other.Act(session_id=neighbour, step=step + 1, observation=OBSERVATION)


def test_a_stream_goes_on_after_a_refusal(addresses):
    with (
        service_with(addresses, "slow") as slow,
        grpc.insecure_channel(addresses.grpc) as channel,
    ):
        session = slow.OpenSession(policy="cartpole").session_id
        request = message_class(channel, "spikeserve.v1.ActRequest")(
            session_id=session, observation=OBSERVATION
        )
        stream = channel.stream_stream(
            f"/{POLICY}/ActStream",
            request_serializer=type(request).SerializeToString,
            response_deserializer=message_class(channel, "spikeserve.v1.ActResponse").FromString,
        )(iter([request] * 12), metadata=[("authorization", "Bearer slow")], timeout=DEADLINE_SECONDS)
        answers = list(stream)
    assert stream.code() == grpc.StatusCode.OK
    assert len(answers) == 12
    refusals = [answer.error for answer in answers if answer.HasField("error")]
    # 5 at once, then one for every 0.2 s; a refusal takes 0.1 s, so at most 2 of 3 are refused. Read on at once, all 7
    # of the others would be.
    assert 0 < len(refusals) <= 6
    for error in refusals:
        assert error.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]
        assert 0 < error.retry_after_seconds <= 0.2


def test_an_oversized_message_is_resource_exhausted(addresses):
    with service_with(addresses, "small") as small, service_with(addresses, "agent") as other:
        labels = {"note": "x" * 220}
        exhausted = grpc.StatusCode.RESOURCE_EXHAUSTED
        assert code_of(small.OpenSession, policy="cartpole", labels=labels) == exhausted
        assert code_of(other.OpenSession, policy="cartpole", labels=labels) == grpc.StatusCode.OK
        # gRPC's own bound, before anything is read.
        assert code_of(other.OpenSession, policy="x" * 5_000_000) == exhausted


def http_get(address, path, header=None):
    request = urllib.request.Request(f"http://{address}{path}")
    if header is not None:
        request.add_header("Authorization", header)
    return urllib.request.urlopen(request, timeout=DEADLINE_SECONDS)


def http_body(address, path, header):
    with http_get(address, path, header) as page:
        return page.read()


def http_code(address, path, header=None):
    try:
        with http_get(address, path, header) as page:
            return page.status
    except urllib.error.HTTPError as error:
        return error.code


PAGES = ("/", "/main.js", "/metrics", "/status.json", "/sessions.json")


@pytest.mark.parametrize("path", [*PAGES, "/explain.json?session=nobody", "/nothing"])
def test_the_status_page_is_for_viewers_and_operators(addresses, path):
    found = 200 if path in PAGES else 404
    assert http_code(addresses.http, path) == 401
    for token in ("wrong", "expired"):
        assert http_code(addresses.http, path, f"Bearer {token}") == 401
    for token in ("agent", "rival", "small"):
        assert http_code(addresses.http, path, f"Bearer {token}") == 403
    for token in ("viewer", "operator", "rival-viewer", "watchman", "machine"):
        assert http_code(addresses.http, path, f"Bearer {token}") == found
    browser = base64.b64encode(b"anyone:operator").decode()
    assert http_code(addresses.http, path, f"Basic {browser}") == found


def test_load_balancers_need_no_token(addresses):
    assert http_code(addresses.http, "/healthz") == 200


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
        # The tenant's sessions are still the tenant's.
        assert new.Act(session_id=session, observation=OBSERVATION).step == 0


def until(condition):
    """Waits for what the server does by itself."""
    deadline = time.monotonic() + DEADLINE_SECONDS
    while not condition():
        assert time.monotonic() < deadline


def openssl(*arguments, cwd):
    subprocess.run(["openssl", *arguments], cwd=cwd, check=True, capture_output=True)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """An authority, and a certificate for each end that it signed."""
    path = tmp_path_factory.mktemp("certificates")
    make_authority(path, "ca")
    for name in ("server", "client"):
        make_certificate(path, name, "ca")
    return path


def make_authority(path, name):
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", f"{name}.key", "-out", f"{name}.pem", "-days", "2", "-subj", f"/CN={name}"),
        cwd=path,
    )


def make_certificate(path, name, authority):
    openssl(
        *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}"),
        cwd=path,
    )
    (path / "names").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    openssl(
        *("x509", "-req", "-in", f"{name}.csr", "-CA", f"{authority}.pem"),
        *("-CAkey", f"{authority}.key", "-CAcreateserial", "-days", "2"),
        *("-extfile", "names", "-out", f"{name}.pem"),
        cwd=path,
    )


def credentials(certificates, client=False, authority="ca"):
    chain = (certificates / "client.pem").read_bytes() if client else None
    key = (certificates / "client.key").read_bytes() if client else None
    root = (certificates / f"{authority}.pem").read_bytes()
    return grpc.ssl_channel_credentials(root, key, chain)


def tls_flags(certificates, *more):
    return [
        f"--tls_certificate={certificates}/server.pem",
        f"--tls_key={certificates}/server.key",
        *more,
    ]


def reaches(address, channel_credentials):
    with grpc.secure_channel(address, channel_credentials) as channel:
        return can_connect(channel)


def can_connect(channel):
    try:
        return Service(channel, HEALTH).Check().status == SERVING
    except (grpc.RpcError, KeyError):  # reflection finds nothing where nobody answers
        return False


def test_tls_encrypts_and_plain_text_is_refused(certificates):
    with running_server(flags=tls_flags(certificates)) as addresses:
        assert reaches(addresses.grpc, credentials(certificates))
        with grpc.insecure_channel(addresses.grpc) as channel:
            assert not can_connect(channel)


def test_mutual_tls_asks_clients_for_a_certificate(certificates):
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem")
    with running_server(flags=flags) as addresses:
        assert reaches(addresses.grpc, credentials(certificates, client=True))
        assert not reaches(addresses.grpc, credentials(certificates))


def test_a_renewed_certificate_is_served_without_a_restart(certificates, tmp_path):
    for name in ("server.pem", "server.key"):
        (tmp_path / name).write_bytes((certificates / name).read_bytes())
    with running_server(flags=tls_flags(tmp_path)) as addresses:
        assert reaches(addresses.grpc, credentials(certificates))
        make_authority(tmp_path, "new")
        make_certificate(tmp_path, "server", "new")
        until(lambda: reaches(addresses.grpc, credentials(tmp_path, authority="new")))


def https_code(certificates, address, path="/healthz", client=False, authority="ca", header=None):
    context = ssl.create_default_context(cafile=certificates / f"{authority}.pem")
    if client:
        context.load_cert_chain(certificates / "client.pem", certificates / "client.key")
    request = urllib.request.Request(f"https://{address}{path}", headers=header or {})
    try:
        with urllib.request.urlopen(request, timeout=DEADLINE_SECONDS, context=context) as page:
            return page.status
    except urllib.error.HTTPError as error:
        return error.code


def test_the_status_page_speaks_tls_too(certificates, tokens):
    with running_server(flags=tls_flags(certificates, f"--tokens={tokens}")) as addresses:
        viewer = {"Authorization": "Bearer viewer"}
        assert https_code(certificates, addresses.http) == 200
        assert https_code(certificates, addresses.http, "/status.json") == 401
        assert https_code(certificates, addresses.http, "/status.json", header=viewer) == 200
        with pytest.raises((urllib.error.URLError, http.client.HTTPException, OSError)):
            http_code(addresses.http, "/healthz")
        # What is left of a handshake that went wrong stands in nobody's way.
        assert https_code(certificates, addresses.http) == 200


def test_mutual_tls_is_the_status_pages_too(certificates):
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem")
    with running_server(flags=flags) as addresses:
        assert https_code(certificates, addresses.http, client=True) == 200
        with pytest.raises((urllib.error.URLError, OSError)):
            https_code(certificates, addresses.http)


def test_a_renewed_certificate_is_the_status_pages_too(certificates, tmp_path):
    for name in ("server.pem", "server.key"):
        (tmp_path / name).write_bytes((certificates / name).read_bytes())
    with running_server(flags=tls_flags(tmp_path)) as addresses:
        assert https_code(certificates, addresses.http) == 200
        make_authority(tmp_path, "new")
        make_certificate(tmp_path, "server", "new")
        assert https_code(tmp_path, addresses.http, authority="new") == 200


def test_encrypted_and_with_tokens_the_page_may_face_the_network(certificates, tokens):
    flags = tls_flags(certificates, f"--tokens={tokens}", "--http_listen=0.0.0.0:0")
    with running_server(flags=flags) as addresses:
        port = addresses.http.rpartition(":")[2]
        assert https_code(certificates, f"127.0.0.1:{port}", "/metrics") == 401


def test_the_programs_speak_tls_and_send_tokens(certificates, tokens):
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem", f"--tokens={tokens}")
    with running_server(flags=flags) as addresses:
        security = [
            f"--server={addresses.grpc}",
            f"--tls_ca={certificates}/ca.pem",
            f"--tls_certificate={certificates}/client.pem",
            f"--tls_key={certificates}/client.key",
        ]

        def run(program, *arguments, token=None):
            environment = {**os.environ}
            environment.pop("SPIKESERVE_TOKEN", None)
            if token is not None:
                environment["SPIKESERVE_TOKEN"] = token
            return subprocess.run(
                [os.environ[program], *arguments, *security],
                env=environment,
                check=False,
                capture_output=True,
                text=True,
                timeout=DEADLINE_SECONDS,
            )

        assert "UNAUTHENTICATED" in run("SPIKECTL_PROGRAM", "policies").stderr
        assert run("SPIKECTL_PROGRAM", "policies", token="agent").returncode == 0
        played = run("SPIKECTL_PROGRAM", "run", "--env=CartPole-v1", token="agent")
        assert played.returncode == 0, played.stderr
        assert (
            "PERMISSION_DENIED" in run("SPIKECTL_PROGRAM", "admin", "drain", token="agent").stderr
        )
        token_file = certificates / "token"
        token_file.write_text("operator\n")
        listed = run("SPIKECTL_PROGRAM", "admin", "sessions", f"--token_file={token_file}")
        assert listed.returncode == 0, listed.stderr
        load = ["--duration=200ms", "--sessions=4", "--mode=stream"]
        loaded = run("SPIKELOAD_PROGRAM", *load, token="agent")
        assert loaded.returncode == 0, loaded.stderr


def test_the_python_client_speaks_tls_and_sends_tokens(certificates, tokens, monkeypatch):
    spikeserve = pytest.importorskip("spikeserve")
    monkeypatch.delenv("SPIKESERVE_TOKEN", raising=False)
    with running_server(flags=tls_flags(certificates, f"--tokens={tokens}")) as addresses:
        with (
            spikeserve.Client(addresses.grpc, credentials=credentials(certificates)) as client,
            pytest.raises(spikeserve.SpikeserveError, match="authorization"),
        ):
            client.list_policies()
        options = spikeserve.ClientOptions(token="agent")
        with (
            spikeserve.Client(addresses.grpc, options, credentials(certificates)) as client,
            client.open_session("cartpole") as session,
        ):
            assert session.act(OBSERVATION).step == 0
        monkeypatch.setenv("SPIKESERVE_TOKEN", "rival")
        with spikeserve.Client(addresses.grpc, credentials=credentials(certificates)) as client:
            assert client.list_policies()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--listen=0.0.0.0:0"], "--listen: expected --tokens for 0.0.0.0:0"),
        (["--listen=0.0.0.0:0", "--tokens={tokens}"], "--listen: expected --tls_certificate"),
        (["--http_listen=0.0.0.0:0"], "--http_listen: expected --tokens"),
        (
            ["--http_listen=0.0.0.0:0", "--tokens={tokens}"],
            "--http_listen: expected --tls_certificate",
        ),
        (["--tls_certificate=missing.pem"], "--tls_key: expected a file"),
        (["--tls_certificate=missing.pem", "--tls_key=missing.key"], "--tls_certificate: expected"),
        (["--tokens=missing.json"], "--tokens: cannot read missing.json"),
    ],
)
def test_an_open_door_is_not_served_by_accident(tmp_path, tokens, flags, message):
    program = [os.environ["SPIKESERVE_PROGRAM"], f"--policies={tmp_path}", "--listen=127.0.0.1:0"]
    flags = [flag.format(tokens=tokens) for flag in flags]
    finished = subprocess.run(
        [*program, "--http_listen=127.0.0.1:0", *flags],
        check=False,
        capture_output=True,
        text=True,
        timeout=DEADLINE_SECONDS,
    )
    assert finished.returncode == 1
    assert f"spikeserve: {message}" in finished.stderr


def test_an_open_door_is_served_where_it_was_asked_for():
    with running_server(flags=["--listen=0.0.0.0:0", "--insecure_network"]) as addresses:
        assert addresses.grpc.startswith("0.0.0.0:")
