"""h2spec: the frames and the compression of headers that the specification of HTTP/2 allows and forbids."""

import re
import xml.etree.ElementTree

import pytest
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
