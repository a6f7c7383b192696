"""Requests in gzip: of gRPC's own client, of HTTP, and what does not decompress."""

import gzip
import http.client
import json
import subprocess

import grpc
import numpy as np
import pytest
import tritonclient.http
from security import POLICY
from serving import DEADLINE_SECONDS, Service

LIMIT = 64 << 10  # bytes of a compressed message of gRPC, once it is decompressed
OBSERVATION = [0.01, -0.02, 0.03, 0.04]


def test_grpcs_client_compresses(server):
    with (
        grpc.insecure_channel(server.grpc) as plain,
        grpc.insecure_channel(server.grpc, compression=grpc.Compression.Gzip) as small,
    ):
        answers = []
        for channel in (plain, small):
            service = Service(plain, POLICY, channel)
            session = service.OpenSession(
                policy="cartpole", labels={"robot": "x" * 200}
            ).session_id
            answers.append(service.Act(session_id=session, observation=OBSERVATION))
        assert answers[0].action.discrete == answers[1].action.discrete
        assert list(answers[0].action_probabilities) == list(
            answers[1].action_probabilities
        )


@pytest.mark.parametrize(
    ("message", "encoding", "code", "text"),
    [
        (gzip.compress(b""), "gzip", grpc.StatusCode.OK, ""),
        (b"no gzip", "gzip", grpc.StatusCode.INTERNAL, "expected one complete member"),
        (
            gzip.compress(b"")[:-1],
            "gzip",
            grpc.StatusCode.INTERNAL,
            "expected one complete member",
        ),
        (
            gzip.compress(b"") * 2,
            "gzip",
            grpc.StatusCode.INTERNAL,
            "expected one complete member",
        ),
        (
            gzip.compress(bytes(LIMIT + 1)),
            "gzip",
            grpc.StatusCode.RESOURCE_EXHAUSTED,
            f"expected at most {LIMIT} bytes",
        ),
        (
            gzip.compress(bytes(1 << 30)),
            "gzip",
            grpc.StatusCode.RESOURCE_EXHAUSTED,
            f"expected at most {LIMIT} bytes",
        ),
        (
            gzip.compress(b""),
            "identity",
            grpc.StatusCode.INTERNAL,
            "expected no compression",
        ),
    ],
    ids=["empty", "other", "short", "two", "long", "bomb", "identity"],
)
def test_compressed_messages(server, message, encoding, code, text):
    """Sends frames that gRPC's own client does not send: curl speaks HTTP/2, too."""
    body = b"\x01" + len(message).to_bytes(4, "big") + message
    command = [
        "curl",
        "--silent",
        "--http2-prior-knowledge",
        "--data-binary",
        "@-",
        "--dump-header",
        "-",
        "--output",
        "/dev/null",
    ]
    command += [
        "--header",
        "content-type: application/grpc",
        "--header",
        f"grpc-encoding: {encoding}",
        "--header",
        "te: trailers",
    ]
    done = subprocess.run(
        [*command, f"http://{server.grpc}/{POLICY}/ListPolicies"],
        input=body,
        capture_output=True,
        check=True,
    )
    headers = dict(
        line.split(": ", 1)
        for line in done.stdout.decode().split("\r\n")
        if ": " in line
    )
    assert int(headers["grpc-status"]) == code.value[0], headers
    assert text in headers.get("grpc-message", "")


def infer_body():
    inputs = [
        {"name": "observation", "shape": [4], "datatype": "FP32", "data": OBSERVATION}
    ]
    return {
        "inputs": inputs,
        "parameters": {"sequence_id": "gzip", "sequence_start": True},
    }


def infer(server, body, encoding):
    connection = http.client.HTTPConnection(server.http, timeout=DEADLINE_SECONDS)
    connection.request(
        "POST", "/v2/models/cartpole/infer", body, {"Content-Encoding": encoding}
    )
    response = connection.getresponse()
    answer = json.load(response)
    connection.close()
    return response.status, answer


def test_bodies_of_http(server):
    body = json.dumps(infer_body()).encode()
    code, answer = infer(server, gzip.compress(body), "gzip")
    assert (code, answer["model_name"]) == (200, "cartpole")
    assert infer(server, body, "gzip") == (
        400,
        {"error": "body: gzip: expected one complete member of the gzip format"},
    )
    assert infer(server, gzip.compress(bytes(1 << 26)), "gzip")[0] == 413
    assert infer(server, body, "deflate") == (
        415,
        {"error": "Content-Encoding: expected gzip or none"},
    )


def test_tritons_client_compresses(server):
    client = tritonclient.http.InferenceServerClient(server.http)
    observation = tritonclient.http.InferInput("observation", [4], "FP32")
    observation.set_data_from_numpy(np.asarray(OBSERVATION, np.float32))
    arguments = {
        "sequence_id": "small",
        "sequence_start": True,
        "request_compression_algorithm": "gzip",
    }
    assert (
        client.infer("cartpole", [observation], **arguments).as_numpy("action")
        is not None
    )
    client.close()
