"""Fixtures that several clients use. PYTHONPATH names tests/python and this folder."""

import grpc
import pytest
from security import credentials, tls_flags
from server_fixtures import addresses, certificates, server, tokens  # noqa: F401
from serving import running_server


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
