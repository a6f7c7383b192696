"""TLS and mutual TLS, with gRPC and with HTTP."""

import contextlib
import http.client
import shutil
import socket
import ssl
import time
import urllib.request

import grpc
import pytest
import spikeserve
from security import (
    HEALTH,
    OBSERVATION,
    SERVING,
    credentials,
    https_code,
    make_authority,
    make_certificate,
    tls_flags,
    until,
)
from serving import DEADLINE_SECONDS, Service, http_call, refusal_at_start, run, running_server


def reaches(folder, addresses, **options):
    """Returns whether gRPC reaches a server with the certificates of a folder."""
    with grpc.secure_channel(addresses.grpc, credentials(folder, **options)) as channel:
        return can_connect(channel)


def has_page(folder, addresses, **options):
    """Returns whether HTTP reaches it."""
    with contextlib.suppress(OSError):
        return https_code(folder, addresses.http, **options) == 200
    return False


def can_connect(channel):
    try:
        return Service(channel, HEALTH).Check().status == SERVING
    except (grpc.RpcError, KeyError):  # KeyError: reflection received no answer
        return False


def test_tls_encrypts_and_plain_text_is_refused(certificates):
    with running_server(flags=tls_flags(certificates)) as addresses:
        assert reaches(certificates, addresses)
        assert not can_connect(addresses.channel)


@pytest.mark.parametrize("is_served", [reaches, has_page])
def test_mutual_tls_asks_clients_for_a_certificate(certificates, is_served):
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem")
    with running_server(flags=flags) as addresses:
        assert is_served(certificates, addresses, client=True)
        assert not is_served(certificates, addresses)


@pytest.mark.parametrize("is_served", [reaches, has_page])
def test_a_renewed_certificate_is_served_without_a_restart(certificates, tmp_path, is_served):
    for name in ("server.pem", "server.key"):
        shutil.copy(certificates / name, tmp_path)
    with running_server(flags=tls_flags(tmp_path)) as addresses:
        assert is_served(certificates, addresses)
        make_authority(tmp_path, "new")
        make_certificate(tmp_path, "server", "new")
        until(lambda: is_served(tmp_path, addresses, authority="new"))


def test_the_status_page_speaks_tls_too(certificates, tokens):
    with running_server(flags=tls_flags(certificates, f"--tokens={tokens}")) as addresses:
        viewer = {"Authorization": "Bearer viewer"}
        assert https_code(certificates, addresses.http) == 200
        assert https_code(certificates, addresses.http, "/status.json") == 401
        assert https_code(certificates, addresses.http, "/status.json", header=viewer) == 200
        with pytest.raises((http.client.HTTPException, OSError)):
            http_call(addresses.http, "GET", "/healthz")
        # A failed handshake does not block later connections.
        assert https_code(certificates, addresses.http) == 200


def test_encrypted_and_with_tokens_the_page_may_face_the_network(certificates, tokens):
    flags = tls_flags(certificates, f"--tokens={tokens}", "--http_listen=0.0.0.0:0")
    with running_server(flags=flags) as addresses:
        port = addresses.http.rpartition(":")[2]
        assert https_code(certificates, f"127.0.0.1:{port}", "/metrics") == 401


@pytest.fixture
def renewed(certificates, tmp_path):
    """Copies the certificates to a folder in which a test may change them, and an expired one beside them."""
    for file in certificates.iterdir():
        shutil.copy(file, tmp_path)
    for name in ("server.pem", "server.key"):
        shutil.copy(tmp_path / name, tmp_path / f"good-{name}")
    make_certificate(tmp_path, "expired", "ca", days=-1)
    return tmp_path


def replace(folder, name):
    """Replaces the server's files by those of another certificate, each at once."""
    for kind in ("pem", "key"):
        shutil.copy(folder / f"{name}.{kind}", folder / "next")
        (folder / "next").rename(folder / f"server.{kind}")


@contextlib.contextmanager
def logged_server(folder, *flags):
    """Starts a server with the certificate of a folder. Yields it and a function that reads its log."""
    log = folder / "log"
    with running_server(flags=tls_flags(folder, *flags), log=log) as addresses:
        yield addresses, log.read_text


def metric(certificates, addresses, name):
    """Returns the value of a time series, or None."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # also of a server whose certificate has expired
    context.load_cert_chain(certificates / "client.pem", certificates / "client.key")
    with urllib.request.urlopen(f"https://{addresses.http}/metrics", timeout=30, context=context) as page:
        lines = page.read().decode().splitlines()
    return next((float(line.split()[-1]) for line in lines if line.startswith(f"{name} ")), None)


EXPIRY = 'spikeserve_tls_expiry_timestamp_seconds{{certificate="{}"}}'
FAILING = "spikeserve_tls_reload_failing"


def test_an_expired_certificate_is_reported(renewed):
    replace(renewed, "expired")
    with logged_server(renewed) as (addresses, log):
        assert metric(renewed, addresses, EXPIRY.format("server")) < time.time()
        assert "error certificate not valid; clients will refuse it" in log()


def test_the_expiry_of_a_certificate_and_of_the_clients_authority_are_metrics(certificates, tmp_path):
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem")
    with running_server(flags=flags) as addresses:
        in_two_days = time.time() + 2 * 86400
        for which in ("server", "client_ca"):
            assert abs(metric(certificates, addresses, EXPIRY.format(which)) - in_two_days) < 3600


def test_files_that_cannot_be_used_are_reported_and_not_used(renewed):
    with logged_server(renewed) as (addresses, log):
        (renewed / "server.pem").write_text("no certificate")
        until(lambda: metric(renewed, addresses, FAILING) == 1)
        said = "error certificate not reloaded; the old one stays in use"
        until(lambda: said in log())
        assert "--tls_certificate: expected a certificate in PEM form" in log()
        assert reaches(renewed, addresses)
        replace(renewed, "good-server")
        until(lambda: metric(renewed, addresses, FAILING) == 0)
        replace(renewed, "expired")
        until(lambda: "expected a certificate that is valid now" in log())
        assert reaches(renewed, addresses)
        (renewed / "server.key").unlink()
        until(lambda: "--tls_key: cannot read" in log())
        make_certificate(renewed, "fresh", "ca")
        replace(renewed, "fresh")
        until(lambda: "info certificate reloaded" in log())
        assert metric(renewed, addresses, FAILING) == 0


@pytest.mark.parametrize("missing", ["server.pem", "server.key"])
def test_a_missing_file_is_named(renewed, missing):
    (renewed / missing).unlink()
    flag = "--tls_certificate" if missing == "server.pem" else "--tls_key"
    said = refusal_at_start(*tls_flags(renewed))
    assert f"{flag}: cannot read {renewed / missing}: No such file or directory" in said


def handshake(address, ciphers):
    """Negotiates TLS 1.2 for HTTP/2 with one suite. Returns whether the server accepts it."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    context.set_ciphers(ciphers)
    context.set_alpn_protocols(["h2"])
    host, _, port = address.rpartition(":")
    try:
        with (
            socket.create_connection((host, int(port)), timeout=30) as plain,
            context.wrap_socket(plain) as encrypted,
        ):
            return encrypted.cipher() is not None
    except (ssl.SSLError, ConnectionError):
        return False


def test_tls_1_2_offers_only_the_suites_of_http2(certificates):
    with running_server(flags=tls_flags(certificates)) as addresses:
        assert handshake(addresses.grpc, "ECDHE-ECDSA-AES128-GCM-SHA256")
        assert handshake(addresses.grpc, "ECDHE-ECDSA-CHACHA20-POLY1305")
        for forbidden in ("ECDHE-ECDSA-AES128-SHA", "ECDHE-ECDSA-AES256-SHA384"):  # CBC
            assert not handshake(addresses.grpc, forbidden)


def test_the_programs_speak_tls_and_send_tokens(certificates, tokens, monkeypatch):
    monkeypatch.delenv("SPIKESERVE_TOKEN", raising=False)
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem", f"--tokens={tokens}")
    with running_server(flags=flags) as addresses:
        security = [
            f"--server={addresses.grpc}",
            f"--tls_ca={certificates}/ca.pem",
            f"--tls_certificate={certificates}/client.pem",
            f"--tls_key={certificates}/client.key",
        ]

        assert "UNAUTHENTICATED" in run("spikectl", "policies", *security, status=1).stderr
        token_file = certificates / "token"
        token_file.write_text("operator\n")
        run("spikectl", "admin", "sessions", f"--token_file={token_file}", *security)
        monkeypatch.setenv("SPIKESERVE_TOKEN", "agent")
        run("spikectl", "policies", *security)
        run("spikectl", "run", "--env=CartPole-v1", *security)
        assert "PERMISSION_DENIED" in run("spikectl", "admin", "drain", *security, status=1).stderr
        run("spikeload", "--duration=200ms", "--sessions=4", "--mode=stream", *security)


def test_the_python_client_speaks_tls_and_sends_tokens(certificates, tokens, monkeypatch):
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
            with client.act_stream() as stream:
                assert stream.act(session, OBSERVATION, 0.0, timeout=DEADLINE_SECONDS).step == 1
        monkeypatch.setenv("SPIKESERVE_TOKEN", "rival")
        with spikeserve.Client(addresses.grpc, credentials=credentials(certificates)) as client:
            assert client.list_policies()
