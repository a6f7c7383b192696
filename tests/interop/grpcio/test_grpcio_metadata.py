"""The newest grpcio: status codes and texts, and metadata."""

import shutil

import grpc
import pytest
from contract import call, v1
from security import POLICY, code_of, fails_with
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, running_server

LIST = f"/{POLICY}/ListPolicies"


def test_a_status_message_keeps_every_character(tmp_path):
    policies = tmp_path / "\t\nπ ☃ 100% 😈\r\n" / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole", policies / "cartpole")
    with (
        running_server(policies=policies) as started,
        grpc.insecure_channel(started.grpc) as channel,
    ):
        with pytest.raises(grpc.RpcError) as missing:
            call(channel, "/spikeserve.v1.PolicyAdmin/LoadPolicy")(
                v1("LoadPolicyRequest", policy="cartpole", version=9), timeout=DEADLINE_SECONDS
            )
    assert missing.value.code() == grpc.StatusCode.NOT_FOUND
    assert missing.value.details() == f"{policies}/cartpole/9/policy.safetensors: expected a file that can be read"


@pytest.mark.parametrize("path", [f"/{POLICY}/NoSuchMethod", "/no.such.Service/Method", "/", "/x"])
def test_an_unknown_method_is_unimplemented(channel, path):
    assert code_of(channel.unary_unary(path), b"", timeout=DEADLINE_SECONDS) == grpc.StatusCode.UNIMPLEMENTED


def test_an_unknown_method_ends_a_stream_of_requests(channel):
    answers = channel.stream_stream(f"/{POLICY}/NoSuchMethod")(
        iter([b"x" * 1000] * 1000), timeout=DEADLINE_SECONDS
    )
    with pytest.raises(grpc.RpcError):
        next(answers)
    assert answers.code() == grpc.StatusCode.UNIMPLEMENTED


def test_a_message_that_cannot_be_parsed_ends_its_call_alone(channel):
    with pytest.raises(grpc.RpcError) as refused:
        channel.unary_unary(f"/{POLICY}/Act")(b"\xff\xff\xff", timeout=DEADLINE_SECONDS)
    # gRPC's C++ server answers UNIMPLEMENTED, those of Go and Java INTERNAL.
    assert refused.value.code() in {
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.UNIMPLEMENTED,
    }
    assert call(channel, LIST)(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS).policies


def test_metadata_of_any_kind_is_accepted(channel):
    metadata = [
        ("x-text", 'a, b; c="d"'),
        ("x-text", "again"),
        ("x-empty", ""),
        ("x-bytes-bin", bytes(range(256))),
        ("x-bytes-bin", b""),
        ("x-bytes-bin", b"\x00"),
        ("authorization", "Bearer nobody"),
    ]
    answer, finished = call(channel, LIST).with_call(
        v1("ListPoliciesRequest"), metadata=metadata, timeout=DEADLINE_SECONDS
    )
    assert answer.policies
    assert finished.code() == grpc.StatusCode.OK


def test_metadata_that_is_too_large_ends_its_call_alone(channel):
    with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED):
        call(channel, LIST)(
            v1("ListPoliciesRequest"), metadata=[("x-text", "x" * 20_000)], timeout=DEADLINE_SECONDS
        )
    assert call(channel, LIST)(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS).policies


def test_a_response_is_not_compressed_without_need(channel):
    _, finished = call(channel, LIST).with_call(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS)
    encodings = [value for key, value in finished.initial_metadata() if key == "grpc-encoding"]
    assert encodings in ([], ["identity"])
