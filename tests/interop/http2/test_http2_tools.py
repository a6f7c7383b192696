"""h2spec: the frames and headers that HTTP/2 allows and forbids; nghttp and h2load, the clients of the nghttp2 project."""

import re
import xml.etree.ElementTree

import pytest
from contract import v1
from programs import require, run
from security import POLICY

CASES = 145

# Cases that the server may fail, each with its reason.
EXEMPT = {
    "http2/5.1.1: Sends stream identifier that is numerically smaller than previous": (
        "nghttp2 ignores such a HEADERS frame on purpose: it may hold trailers that were sent before the client has "
        "received a RST_STREAM"
    ),
    "http2/5.1.2: Sends HEADERS frames that causes their advertised concurrent stream limit to be exceeded": (
        "the server may answer each request before the next one arrives, and then the limit is not reached"
    ),
}


def report(address, path, *flags):
    """Runs h2spec. Returns its cases and, of those that failed, what h2spec expected and received."""
    host, _, port = address.rpartition(":")
    junit = path / "h2spec.xml"
    finished = run(
        *(require("h2spec"), f"--host={host}", f"--port={port}", f"--path=/{POLICY}/ListPolicies"),
        *(f"--junit-report={junit}", *flags),
        timeout=400,
    )
    assert junit.exists(), finished.stdout + finished.stderr
    # h2spec writes the debug data of GOAWAY frames as they are, which XML may not contain.
    text = re.sub(rb"[^\t\n\r -~]", b"?", junit.read_bytes())
    cases = list(xml.etree.ElementTree.fromstring(text).iter("testcase"))
    failed = {}
    for case in cases:
        name = f"{case.get('package')}: {case.get('classname')}"
        problems = [*case.iter("error"), *case.iter("failure")]
        if problems:
            failed[name] = " | ".join(str(problem.text).strip() for problem in problems)
    return cases, failed


@pytest.mark.parametrize("fixture", ["server", "tls_server"])
def test_every_case_passes(request, tmp_path, fixture):
    flags = ["--tls", "--insecure"] if fixture == "tls_server" else []
    cases, failed = report(request.getfixturevalue(fixture).grpc, tmp_path, *flags)
    assert len(cases) == CASES
    assert {name: text for name, text in failed.items() if name not in EXEMPT} == {}


GRPC_HEADERS = ["--header=content-type: application/grpc", "--header=te: trailers"]


def test_a_get_over_tls_is_answered(tls_server):
    fetched = run(require("nghttp"), "-v", "-n", f"https://{tls_server.grpc}/{POLICY}/ListPolicies")
    assert fetched.returncode == 0, fetched.stderr
    assert "The negotiated protocol: h2" in fetched.stdout
    assert re.search(r"recv \(stream_id=\d+\) :status: \d+", fetched.stdout)


@pytest.mark.parametrize("fixture", ["server", "tls_server"])
def test_calls_of_h2load(request, tmp_path, fixture):
    message = v1("ActBatchRequest", requests=[v1("ActRequest", session_id="x")] * 10).SerializeToString()
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
