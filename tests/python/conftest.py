"""A real server for every test file that wants one."""

import contextlib
import os
import pathlib
import subprocess

import pytest

SHIPPED_POLICIES = pathlib.Path(__file__).parents[2] / "deploy" / "policies"
STOP_SECONDS = 30


@contextlib.contextmanager
def serving(policies):
    """The gRPC address of a server with the policies in the folder `policies`."""
    server = subprocess.Popen(
        [
            os.environ["SPIKESERVE_PROGRAM"],
            f"--policies={policies}",
            "--listen=127.0.0.1:0",
            "--http_listen=",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        announcement = "spikeserve: serving gRPC on "
        line = server.stdout.readline()
        assert line.startswith(announcement), f"the server said {line!r}"
        yield line.removeprefix(announcement).strip()
        server.terminate()
        assert server.wait(timeout=STOP_SECONDS) == 0
    finally:
        server.kill()
        server.wait()
        server.stdout.close()


@pytest.fixture(scope="module")
def address():
    """The gRPC address of a server with the shipped policies."""
    with serving(SHIPPED_POLICIES) as started:
        yield started
