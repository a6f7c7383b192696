"""ghz: many calls of grpc-go at a time."""

import json

import pytest
from programs import require, run
from security import POLICY


def ghz(address, call, *flags):
    """Runs ghz and returns the number of answers by status."""
    finished = run(
        *(require("ghz"), "--format=json", f"--call={call}", "--timeout=20s", *flags, address),
        timeout=60,
    )
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)["statusCodeDistribution"]


def test_unary_calls_on_one_connection(server):
    flags = ["--insecure", "--total=2000", "--concurrency=100"]
    assert ghz(server.grpc, f"{POLICY}.ListPolicies", *flags) == {"OK": 2000}


def test_unary_calls_on_many_connections(server):
    flags = ["--insecure", "--total=2000", "--concurrency=100", "--connections=50"]
    assert ghz(server.grpc, "grpc.health.v1.Health.Check", *flags) == {"OK": 2000}


def test_a_thousand_calls_at_a_time(server):
    flags = ["--insecure", "--total=1000", "--concurrency=1000"]
    assert ghz(server.grpc, f"{POLICY}.ListPolicies", *flags) == {"OK": 1000}


def test_calls_that_are_refused(server):
    flags = [
        "--insecure",
        "--total=500",
        "--concurrency=50",
        '--data={"session_id": "{{.RequestNumber}}"}',
    ]
    assert ghz(server.grpc, f"{POLICY}.CloseSession", *flags) == {"NotFound": 500}


def test_streams(server):
    data = json.dumps([{"session_id": "x", "step": step} for step in range(10)])
    flags = ["--insecure", "--total=200", "--concurrency=50", f"--data={data}"]
    assert ghz(server.grpc, f"{POLICY}.ActStream", *flags) == {"OK": 200}


@pytest.mark.parametrize("mutual", [False, True])
def test_tls(request, certificates, mutual):
    flags = [f"--cacert={certificates}/ca.pem"]
    if mutual:
        flags += [f"--cert={certificates}/client.pem", f"--key={certificates}/client.key"]
    address = request.getfixturevalue("mutual_tls_server" if mutual else "tls_server").grpc
    flags += ["--total=500", "--concurrency=50", "--connections=10"]
    assert ghz(address, f"{POLICY}.ListPolicies", *flags) == {"OK": 500}
