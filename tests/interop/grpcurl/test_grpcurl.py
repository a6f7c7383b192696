"""grpcurl: grpc-go with messages from reflection."""

import json

import pytest
from programs import require, run
from security import OBSERVATION, POLICY

STATUS_BASE = 64  # grpcurl exits with 64 plus the gRPC status
NOT_FOUND, UNAUTHENTICATED, DEADLINE_EXCEEDED = 5, 16, 4


def grpcurl(address, *arguments, flags=("-plaintext",), **options):
    """Runs grpcurl with flags, the address and the arguments after it."""
    return run(require("grpcurl"), *flags, address, *arguments, **options)


def answer_of(finished):
    """Returns the JSON of a call that succeeded."""
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)


def test_list_names_the_services(server):
    listed = grpcurl(server.grpc, "list")
    assert listed.returncode == 0, listed.stderr
    expected = {
        POLICY,
        "spikeserve.v1.PolicyAdmin",
        "inference.GRPCInferenceService",
        "grpc.health.v1.Health",
        "grpc.reflection.v1.ServerReflection",
    }
    assert expected <= set(listed.stdout.split())


@pytest.mark.parametrize("symbol", [POLICY, f"{POLICY}.Act", "spikeserve.v1.ActRequest"])
def test_describe_shows_a_symbol(server, symbol):
    described = grpcurl(server.grpc, "describe", symbol)
    assert described.returncode == 0, described.stderr
    assert symbol in described.stdout


def test_a_unary_call(server):
    assert answer_of(grpcurl(server.grpc, f"{POLICY}/ListPolicies"))["policies"]


def test_a_stream(server):
    opened = grpcurl(server.grpc, f"{POLICY}/OpenSession", flags=["-plaintext", "-d", '{"policy": "cartpole"}'])
    session = answer_of(opened)["session_id"]
    requests = "".join(
        json.dumps({"session_id": session, "step": step, "observation": OBSERVATION}) for step in range(20)
    )
    played = grpcurl(server.grpc, f"{POLICY}/ActStream", flags=["-plaintext", "-d", "@"], input=requests)
    assert played.returncode == 0, played.stderr
    assert played.stdout.count("session_id") == 20
    assert "error" not in played.stdout


def test_the_details_of_a_status_are_decoded(addresses):
    flags = ["-plaintext", "-H", "authorization: Bearer small", "-d", '{"policy": "cartpole"}']
    for _ in range(2):
        answer_of(grpcurl(addresses.grpc, f"{POLICY}/OpenSession", flags=flags))
    refused = grpcurl(addresses.grpc, f"{POLICY}/OpenSession", flags=[*flags, "-format-error"])
    (detail,) = json.loads(refused.stderr)["details"]
    assert detail["@type"].endswith("google.rpc.RetryInfo")


def test_metadata_is_read(addresses):
    refused = grpcurl(addresses.grpc, f"{POLICY}/ListPolicies")
    assert refused.returncode == STATUS_BASE + UNAUTHENTICATED
    flags = ["-plaintext", "-H", "authorization: Bearer agent", "-H", "x-bytes-bin: /////w=="]
    assert answer_of(grpcurl(addresses.grpc, f"{POLICY}/ListPolicies", flags=flags))


def test_tls(tls_server, certificates):
    flags = ["-cacert", certificates / "ca.pem"]
    assert answer_of(grpcurl(tls_server.grpc, f"{POLICY}/ListPolicies", flags=flags))["policies"]
    assert grpcurl(tls_server.grpc, "list", flags=["-plaintext", "-connect-timeout=1"]).returncode != 0
