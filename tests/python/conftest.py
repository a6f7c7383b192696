"""Fixtures that several test files use."""

import pathlib
import re

import grpc
import pytest
from links import Link
from redis_servers import DURABLE, PASSWORD, Redis, stopping
from security import POLICY
from serving import Service, running_server
from server_fixtures import addresses, certificates, server, tokens  # noqa: F401


@pytest.fixture(scope="module")
def address():
    """Starts a server with the shipped policies and yields its gRPC address."""
    with running_server() as addresses:
        yield addresses.grpc


@pytest.fixture(scope="module")
def service(address):
    """Yields PolicyService of the server at `address`."""
    with grpc.insecure_channel(address) as channel:
        yield Service(channel, POLICY)


@pytest.fixture(scope="module")
def client(address):
    """Yields the Python client, connected to `address`."""
    import spikeserve  # tests that do not use it run without it

    with spikeserve.Client(address) as opened:
        yield opened


@pytest.fixture
def link(address):
    """Yields a Link to the server at `address`."""
    with Link(address) as opened:
        yield opened


@pytest.fixture
def redis():
    """Starts a Redis server that keeps what it has acknowledged."""
    with stopping([Redis(*DURABLE, password="")]) as [started]:
        yield started


@pytest.fixture
def password(tmp_path):
    """Writes redis_servers.PASSWORD to a file and returns the flag for it."""
    path = tmp_path / "password"
    path.write_text(PASSWORD)
    return f"--store_password_file={path}"


@pytest.fixture(scope="module")
def browser():
    """Starts a headless Chromium."""
    from browser import chromium  # not every environment in which tests run can control one

    with chromium() as started:
        yield started


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
