"""Fixtures that several clients use. PYTHONPATH names tests/python and this folder."""

import json

import grpc
import pytest
from security import TOKENS, credentials, make_authority, make_certificate, tls_flags
from serving import running_server


@pytest.fixture(scope="session")
def certificates(tmp_path_factory):
    """Makes a certificate authority that signs a server and a client certificate. Returns the folder."""
    path = tmp_path_factory.mktemp("certificates")
    make_authority(path, "ca")
    for name in ("server", "client"):
        make_certificate(path, name, "ca")
    return path


@pytest.fixture(scope="module")
def server():
    """Starts a server with the shipped policies and yields it as a Server."""
    with running_server() as addresses:
        yield addresses


@pytest.fixture(scope="module")
def tls_server(certificates):
    """As `server`, with TLS."""
    with running_server(flags=tls_flags(certificates)) as addresses:
        yield addresses


@pytest.fixture(scope="module")
def mutual_tls_server(certificates):
    """As `server`, with TLS and client certificates."""
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem")
    with running_server(flags=flags) as addresses:
        yield addresses


@pytest.fixture
def channel(server):
    """A new channel of grpcio to `server`, with no limit on the length of responses."""
    with grpc.insecure_channel(server.grpc, [("grpc.max_receive_message_length", -1)]) as opened:
        yield opened


@pytest.fixture
def tls_credentials(certificates):
    """Channel credentials with the authority of `certificates`."""
    return credentials(certificates)


@pytest.fixture(scope="module")
def tokens_server(tmp_path_factory):
    """As `server`, with the tokens of security.TOKENS."""
    path = tmp_path_factory.mktemp("tokens") / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    with running_server(flags=[f"--tokens={path}"]) as addresses:
        yield addresses
