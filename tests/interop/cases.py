"""The cases that the clients in other languages implement, each as one run of a program.

The tests call a fixture `client`: `check` for one program.
"""

import contextlib
import pathlib
import shutil

import pytest
from contract import PROTO
from programs import run
from serving import SHIPPED_POLICIES, running_server

NAMES = [
    "empty_unary",
    "large_unary",
    "ping_pong",
    "half_close",
    "empty_stream",
    "cancel_after_begin",
    "cancel_after_first_response",
    "timeout",
    "metadata",
    "unimplemented",
    "compression",
    "concurrent",
    "health",
]
CORE = ["empty_unary", "large_unary", "ping_pong", "unimplemented"]  # of every transport


def check(client, case, address, *files, **environment):
    """Runs a case: `client`, a command, with the case, the address, the folder of .proto files and `files`."""
    finished = run(
        "env", *(f"{k}={v}" for k, v in environment.items()), *client, case, address, PROTO, *files
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr


@contextlib.contextmanager
def odd_server(path: pathlib.Path):
    """Starts a server whose folder has an odd name. Yields it and the start of its error messages."""
    policies = path / "π ☃ 100%\n" / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole", policies / "cartpole")
    with running_server(policies=policies) as started:
        yield started, f"{policies}/cartpole/9/policy.safetensors"


@pytest.mark.parametrize("case", NAMES)
def test_plain_text(client, server, case):
    client(case, server.grpc)


@pytest.mark.parametrize("case", CORE)
def test_tls(client, tls_server, certificates, case):
    client(case, tls_server.grpc, certificates / "ca.pem")


@pytest.mark.parametrize("case", CORE)
def test_mutual_tls(client, mutual_tls_server, certificates, case):
    names = ("ca.pem", "client.pem", "client.key")
    client(case, mutual_tls_server.grpc, *(certificates / name for name in names))


def test_unix_socket(client, tmp_path):
    with running_server(flags=[f"--listen=unix:{tmp_path}/spikeserve.sock"]) as started:
        for case in CORE:
            client(case, started.grpc)


def test_a_status_message_with_any_character(client, tmp_path):
    with odd_server(tmp_path) as (started, message):
        client("status_message", started.grpc, EXPECTED_MESSAGE=message)
