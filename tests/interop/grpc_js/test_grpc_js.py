"""grpc-js, the implementation for Node.js."""

import pathlib

import cases
import pytest
from programs import INSTALLED, missing, require
from serving import running_server

CLIENT = pathlib.Path(__file__).parent / "client.js"
MODULES = INSTALLED / "grpc_js" / "node_modules"


def check(case, address, *files, **environment):
    node = require("node")
    if not MODULES.exists():
        missing(f"{MODULES}: expected the modules that `deploy/setup.sh` installs, found none")
    cases.check([node, CLIENT], case, address, *files, NODE_PATH=MODULES, **environment)


@pytest.mark.parametrize("case", cases.NAMES)
def test_plain_text(server, case):
    check(case, server.grpc)


@pytest.mark.parametrize("case", cases.CORE)
def test_tls(tls_server, certificates, case):
    check(case, tls_server.grpc, certificates / "ca.pem")


@pytest.mark.parametrize("case", cases.CORE)
def test_mutual_tls(mutual_tls_server, certificates, case):
    names = ("ca.pem", "client.pem", "client.key")
    check(case, mutual_tls_server.grpc, *(certificates / name for name in names))


def test_unix_socket(tmp_path):
    with running_server(flags=[f"--listen=unix:{tmp_path}/spikeserve.sock"]) as started:
        for case in cases.CORE:
            check(case, started.grpc)


def test_a_status_message_with_any_character(tmp_path):
    with cases.odd_server(tmp_path) as (started, message):
        check("status_message", started.grpc, EXPECTED_MESSAGE=message)
