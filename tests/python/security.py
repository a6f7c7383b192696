"""Tokens, certificates, and clients that use them."""

import contextlib
import hashlib
import ssl
import subprocess
import time
import urllib.error
import urllib.request

import grpc
import pytest
from serving import ADMIN, DEADLINE_SECONDS, POLICY, Service  # noqa: F401

HEALTH = "grpc.health.v1.Health"
SERVING = 1
OBSERVATION = [0.01, -0.02, 0.03, 0.1]


def entry(token, role, tenant="fleet", **more):
    """Returns the entry of a token in the token file."""
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
        entry("nina", "operator", name="nina"),
        entry("rival", "agent", "rival"),
        entry("rival-viewer", "viewer", "rival", sees="tenant"),
        entry("rival-operator", "operator", "rival"),
        entry("small", "agent", "small"),
        entry("slow", "agent", "slow"),
        entry("expired", "agent", expires="2001-01-01T00:00:00Z"),
    ],
}


class Bearer(grpc.UnaryUnaryClientInterceptor):
    """Sends a token with every call."""

    def __init__(self, token):
        self._metadata = (("authorization", f"Bearer {token}"),)

    def intercept_unary_unary(self, continuation, client_call_details, request):
        return continuation(client_call_details._replace(metadata=self._metadata), request)


@contextlib.contextmanager
def service_with(addresses, token, name=POLICY):
    with grpc.insecure_channel(addresses.grpc) as channel:
        described = Service(channel, name)  # reflection needs no token
        if token is not None:
            described = Service(channel, name, grpc.intercept_channel(channel, Bearer(token)))
        yield described


def code_of(call, *arguments, **fields):
    try:
        call(*arguments, **fields)
    except grpc.RpcError as error:
        return error.code()
    return grpc.StatusCode.OK


@contextlib.contextmanager
def fails_with(code, part="", whole=None):
    """Asserts that a call in the block fails with `code`, and with details that have `part` in them, or are `whole`."""
    with pytest.raises(grpc.RpcError) as error:
        yield error
    assert error.value.code() == code, error.value
    assert part in error.value.details()
    assert whole in (None, error.value.details())


def until(condition, seconds=120):
    """Waits until `condition()` is true, and returns it. Fails after `seconds`, which are many, because machines are busy at times."""
    deadline = time.monotonic() + seconds
    while not (outcome := condition()):
        assert time.monotonic() < deadline, f"the condition was false for {seconds} s"
        time.sleep(0.01)  # leaves the processor to those who make it true
    return outcome


def openssl(*arguments, cwd):
    subprocess.run(["openssl", *arguments], cwd=cwd, check=True, capture_output=True)


def make_authority(path, name):
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", f"{name}.key", "-out", f"{name}.pem", "-days", "2", "-subj", f"/CN={name}"),
        cwd=path,
    )


def make_certificate(path, name, authority, days=2):
    openssl(
        *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"),
        *("-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}"),
        cwd=path,
    )
    (path / "names").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    openssl(
        *("x509", "-req", "-in", f"{name}.csr", "-CA", f"{authority}.pem"),
        *("-CAkey", f"{authority}.key", "-CAcreateserial", "-days", str(days)),
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
