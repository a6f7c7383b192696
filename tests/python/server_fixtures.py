"""Fixtures of servers, tokens and certificates, which tests in several folders import."""

import json

import pytest
from security import TOKENS, make_authority, make_certificate
from serving import running_server


@pytest.fixture(scope="module")
def server():
    """Starts a server with the shipped policies and yields it as a Server."""
    with running_server() as started:
        yield started


@pytest.fixture(scope="module")
def tokens(tmp_path_factory):
    """Writes security.TOKENS to a file and returns its path."""
    path = tmp_path_factory.mktemp("tokens") / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    return path


@pytest.fixture(scope="module")
def addresses(tokens):
    """Starts a server that requires tokens and yields it as a Server."""
    with running_server(flags=[f"--tokens={tokens}"]) as started:
        yield started


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """Makes a certificate authority that signs a server and a client certificate. Returns the folder."""
    path = tmp_path_factory.mktemp("certificates")
    make_authority(path, "ca")
    for name in ("server", "client"):
        make_certificate(path, name, "ca")
    return path
