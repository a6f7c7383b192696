"""h2spec: the frames and the compression of headers that the specification of HTTP/2 allows and forbids."""

import xml.etree.ElementTree

import pytest
import transport
from programs import require, run
from security import POLICY

CASES = 145

# Cases that the server may fail, each with its reason.
EXEMPT = {}


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
    cases = list(xml.etree.ElementTree.parse(junit).getroot().iter("testcase"))
    failed = {}
    for case in cases:
        name = f"{case.get('package')}: {case.get('classname')}"
        problems = [*case.iter("error"), *case.iter("failure")]
        if problems:
            failed[name] = " | ".join(problem.text.strip() for problem in problems)
    return cases, failed


@pytest.mark.skipif(not transport.NGHTTP2, reason="gRPC's own server fails 49 of the 145 cases")
@pytest.mark.parametrize("fixture", ["server", "tls_server"])
def test_every_case_passes(request, tmp_path, fixture):
    flags = ["--tls", "--insecure"] if fixture == "tls_server" else []
    cases, failed = report(request.getfixturevalue(fixture).grpc, tmp_path, *flags)
    assert len(cases) == CASES
    assert {name: text for name, text in failed.items() if name not in EXEMPT} == {}
    assert set(EXEMPT) <= set(failed), "a case that passes needs no exemption"
