"""What several test files ask for."""

import json

import pytest
from security import TOKENS, make_authority, make_certificate
from serving import running_server


@pytest.fixture(scope="module")
def address():
    """The gRPC address of a server with the shipped policies."""
    with running_server() as addresses:
        yield addresses.grpc


@pytest.fixture(scope="module")
def tokens(tmp_path_factory):
    """The file of security.TOKENS."""
    path = tmp_path_factory.mktemp("tokens") / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    return path


@pytest.fixture(scope="module")
def addresses(tokens):
    """The Addresses of a server that asks for tokens."""
    with running_server(flags=[f"--tokens={tokens}"]) as started:
        yield started


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """An authority, and a certificate for each end that it signed."""
    path = tmp_path_factory.mktemp("certificates")
    make_authority(path, "ca")
    for name in ("server", "client"):
        make_certificate(path, name, "ca")
    return path
