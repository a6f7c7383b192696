"""Fixtures that several test files use."""

import json
import pathlib
import re

import pytest
from security import TOKENS, make_authority, make_certificate
from serving import running_server


@pytest.fixture(scope="module")
def address():
    """Starts a server with the shipped policies and yields its gRPC address."""
    with running_server() as addresses:
        yield addresses.grpc


@pytest.fixture(scope="module")
def browser():
    """Starts a headless Chromium."""
    from browser import chromium  # not every environment in which tests run can control one

    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def tokens(tmp_path_factory):
    """Writes security.TOKENS to a file and returns its path."""
    path = tmp_path_factory.mktemp("tokens") / "tokens.json"
    path.write_text(json.dumps(TOKENS))
    return path


@pytest.fixture(scope="module")
def addresses(tokens):
    """Starts a server that requires tokens and yields its Addresses."""
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


@pytest.fixture(scope="module")
def defined():
    """Returns the names of all tests, their suites and files, and of all attacks."""
    names = set()
    for path in pathlib.Path(__file__).parents[1].rglob("*"):
        if path.suffix == ".py":
            names.update(re.findall(r"^def (\w+)\(", path.read_text(), re.MULTILINE))
        elif path.suffix == ".cc":
            names.add(path.stem)
            for suite, name in re.findall(r"^TEST(?:_F|_P)?\((\w+),\s*(\w+)\)", path.read_text(), re.MULTILINE):
                names.update((suite, name))
    return names
