"""TLS and mutual TLS, with gRPC and with HTTP."""

import http.client
import urllib.error

import grpc
import pytest
from security import (
    HEALTH,
    SERVING,
    credentials,
    http_code,
    https_code,
    make_authority,
    make_certificate,
    tls_flags,
    until,
)
from serving import Service, running_server


def reaches(address, channel_credentials):
    with grpc.secure_channel(address, channel_credentials) as channel:
        return can_connect(channel)


def can_connect(channel):
    try:
        return Service(channel, HEALTH).Check().status == SERVING
    except (grpc.RpcError, KeyError):  # KeyError: reflection received no answer
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


def test_the_status_page_speaks_tls_too(certificates, tokens):
    with running_server(flags=tls_flags(certificates, f"--tokens={tokens}")) as addresses:
        viewer = {"Authorization": "Bearer viewer"}
        assert https_code(certificates, addresses.http) == 200
        assert https_code(certificates, addresses.http, "/status.json") == 401
        assert https_code(certificates, addresses.http, "/status.json", header=viewer) == 200
        with pytest.raises((urllib.error.URLError, http.client.HTTPException, OSError)):
            http_code(addresses.http, "/healthz")
        # A failed handshake does not block later connections.
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

        def is_served():
            try:
                return https_code(tmp_path, addresses.http, authority="new") == 200
            except OSError:
                return False

        until(is_served)


def test_encrypted_and_with_tokens_the_page_may_face_the_network(certificates, tokens):
    flags = tls_flags(certificates, f"--tokens={tokens}", "--http_listen=0.0.0.0:0")
    with running_server(flags=flags) as addresses:
        port = addresses.http.rpartition(":")[2]
        assert https_code(certificates, f"127.0.0.1:{port}", "/metrics") == 401
