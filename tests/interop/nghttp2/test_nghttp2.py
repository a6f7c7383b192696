"""nghttp and h2load: the clients of the nghttp2 project."""

import re

import pytest
from contract import v1
from programs import require, run
from security import POLICY

GRPC_HEADERS = ["--header=content-type: application/grpc", "--header=te: trailers"]


def test_a_get_is_answered(server):
    fetched = run(require("nghttp"), "-v", "-n", f"http://{server.grpc}/{POLICY}/ListPolicies")
    assert fetched.returncode == 0, fetched.stderr
    (status,) = re.findall(r"recv \(stream_id=\d+\) :status: (\d+)", fetched.stdout)
    assert status == "405"


def test_a_get_over_tls_is_answered(tls_server):
    fetched = run(require("nghttp"), "-v", "-n", f"https://{tls_server.grpc}/{POLICY}/ListPolicies")
    assert fetched.returncode == 0, fetched.stderr
    assert "The negotiated protocol: h2" in fetched.stdout
    assert re.search(r"recv \(stream_id=\d+\) :status: \d+", fetched.stdout)


def test_a_call_of_nghttp_has_its_trailers(server, tmp_path):
    body = tmp_path / "request"
    body.write_bytes(b"\0\0\0\0\0")
    called = run(
        *(require("nghttp"), "-v", "-n", *GRPC_HEADERS, f"--data={body}"),
        f"http://{server.grpc}/{POLICY}/ListPolicies",
    )
    assert called.returncode == 0, called.stderr
    assert "grpc-status: 0" in called.stdout


@pytest.mark.parametrize("fixture", ["server", "tls_server"])
def test_calls_of_h2load(request, tmp_path, fixture):
    message = v1(
        "ActBatchRequest", requests=[v1("ActRequest", session_id="x")] * 10
    ).SerializeToString()
    body = tmp_path / "request"
    body.write_bytes(b"\0" + len(message).to_bytes(4) + message)
    scheme = "https" if fixture == "tls_server" else "http"
    address = request.getfixturevalue(fixture).grpc
    loaded = run(
        *(require("h2load"), "--requests=1000", "--clients=10", "--max-concurrent-streams=50"),
        *(*GRPC_HEADERS, f"--data={body}", f"{scheme}://{address}/{POLICY}/ActBatch"),
    )
    assert loaded.returncode == 0, loaded.stderr
    assert "1000 succeeded, 0 failed, 0 errored, 0 timeout" in loaded.stdout, loaded.stdout
