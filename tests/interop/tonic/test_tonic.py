"""tonic, the implementation for Rust. Builds its client first, which takes minutes."""

import pathlib
import subprocess

import cases
import pytest
from programs import INSTALLED, require
from serving import running_server

CRATE = pathlib.Path(__file__).parent
TARGET = INSTALLED / "tonic"


@pytest.fixture(scope="module")
def client():
    """Builds the crate with the versions of Cargo.lock. Returns the command of the client."""
    cargo = require("cargo")  # 1.88 or later; Debian 12 has it as cargo-web
    subprocess.run(
        [cargo, "build", "--locked", "--quiet", f"--target-dir={TARGET}"], cwd=CRATE, check=True
    )
    return [TARGET / "debug" / "interop"]


@pytest.mark.parametrize("case", cases.NAMES)
def test_plain_text(client, server, case):
    cases.check(client, case, server.grpc)


@pytest.mark.parametrize("case", cases.CORE)
def test_tls(client, tls_server, certificates, case):
    cases.check(client, case, tls_server.grpc, certificates / "ca.pem")


@pytest.mark.parametrize("case", cases.CORE)
def test_mutual_tls(client, mutual_tls_server, certificates, case):
    names = ("ca.pem", "client.pem", "client.key")
    cases.check(client, case, mutual_tls_server.grpc, *(certificates / name for name in names))


def test_unix_socket(client, tmp_path):
    with running_server(flags=[f"--listen=unix:{tmp_path}/spikeserve.sock"]) as started:
        for case in cases.CORE:
            cases.check(client, case, started.grpc)


def test_a_status_message_with_any_character(client, tmp_path):
    with cases.odd_server(tmp_path) as (started, message):
        cases.check(client, "status_message", started.grpc, EXPECTED_MESSAGE=message)
