"""The HTTP port admits like gRPC's: rights, size and rate come before the body is read, and refusals take their time."""

import concurrent.futures
import contextlib
import gzip
import http.client
import json
import socket
import ssl
import threading
import time

import pytest
from security import (
    ADMIN,
    POLICY,
    TOKENS,
    entry,
    tls_flags,
)
from serving import DEADLINE_SECONDS, http_call, running_server, schedule_of, series
from test_grpc_web import BINARY, framed, parts
from test_http_inference import infer_body

INFER = "/v2/models/cartpole/infer"
PACED_SECONDS = 0.05  # at least, of a refusal
LIMITED = {"decisions_per_second": 10, "max_message_bytes": 1024}


@pytest.fixture(scope="module")
def door(tmp_path_factory):
    """A server with a tenant that has limits, "small"."""
    path = tmp_path_factory.mktemp("door") / "tokens.json"
    tenants = TOKENS["tenants"] | {"small": LIMITED, "listed": {"calls_per_second": {"listing": 1}}}
    listed = entry("listed", "viewer", "listed")
    path.write_text(json.dumps({"tenants": tenants, "tokens": [*TOKENS["tokens"], listed]}))
    with running_server(flags=[f"--tokens={path}"]) as addresses:
        yield addresses


def ask(address, method, path, body=None, token=None, **headers):
    """Returns the code, the body, and the seconds that the answer took."""
    start = time.monotonic()
    status, _, content = http_call(address, method, path, body, token, **headers)
    return status, content, time.monotonic() - start


def raw(address, *pieces):
    """Sends bytes, and returns the first line and the body of the answer."""
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=DEADLINE_SECONDS) as connection:
        for piece in pieces:
            connection.sendall(piece)
        answer = b"".join(iter(lambda: connection.recv(1 << 16), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    return head.split(b"\r\n")[0], body


def infer(address, sequence, token, **headers):
    body = json.dumps(infer_body(sequence, start=True)).encode()
    return ask(address, "POST", INFER, body, token, **headers)


@pytest.mark.parametrize(
    ("method", "path", "headers", "code"),
    [
        ("GET", "/status.json", {}, 401),
        ("GET", "/metrics", {}, 401),
        ("GET", "/v2/health/live", {}, 401),
        ("POST", INFER, {}, 401),
        ("POST", f"/{POLICY}/Act", {"Content_Type": BINARY}, 200),
    ],
)
def test_guesses_of_a_token_take_their_time(door, method, path, headers, code):
    body = framed(b"") if method == "POST" else None
    status, content, seconds = ask(door.http, method, path, body, "wrong", **headers)
    assert status == code and seconds >= PACED_SECONDS
    assert code != 200 or parts(content)[1]["grpc-status"] == "16"
    with concurrent.futures.ThreadPoolExecutor(40) as guessers:
        start = time.monotonic()
        codes = list(guessers.map(lambda _: ask(door.http, method, path, body, "wrong", **headers)[0], range(120)))
        # One every two milliseconds at most, whatever the number of guessers.
        assert time.monotonic() - start >= 120 * 0.002
    assert set(codes) == {code}


def test_a_body_is_not_read_for_a_tenant_that_may_not_send_it(door):
    """The length that the header tells is enough: none of the body is waited for."""
    head = f"POST {INFER} HTTP/1.1\r\nAuthorization: Bearer small\r\nContent-Length: 5000\r\n\r\n"
    line, body = raw(door.http, head.encode())
    assert line.split()[1] == b"429"
    assert "max_message_bytes: expected at most 1024 for tenant small" in json.loads(body)["error"]
    big = json.dumps(infer_body("big", start=True) | {"id": "x" * 1200}).encode()
    status, body, _ = ask(door.http, "POST", INFER, gzip.compress(big), "small", Content_Encoding="gzip")
    assert status == 413
    head = f"POST /{POLICY}/Act HTTP/1.1\r\nAuthorization: Bearer small\r\nContent-Type: {BINARY}\r\nContent-Length: 5000\r\n\r\n"
    line, body = raw(door.http, head.encode())
    assert line.split()[1] == b"200" and parts(body)[1]["grpc-status"] == "8"


def test_the_rate_comes_before_the_body(door):
    """A body that is no JSON uses the rate of decisions, too, and beyond it the body is not looked at."""
    codes = [ask(door.http, "POST", INFER, b"no JSON", "small")[0] for _ in range(40)]
    assert 10 <= codes.count(400) < 40 and codes.count(429) == 40 - codes.count(400)
    head = f"POST {INFER} HTTP/1.1\r\nAuthorization: Bearer small\r\nContent-Length: 500\r\n\r\n".encode()
    lines = {raw(door.http, head + b"x" * 500)[0].split()[1] for _ in range(20)}
    assert b"429" in lines


def test_one_decision_is_counted_once(door):
    """A tenant with 5 decisions a second makes at least five at once."""
    codes = [infer(door.http, f"once {i}", "slow")[0] for i in range(5)]
    assert codes == [200] * 5


def test_pages_have_a_rate(door):
    codes = [ask(door.http, "GET", "/status.json", token="listed")[0] for _ in range(4)]
    assert codes[0] == 200 and 429 in codes
    assert ask(door.http, "GET", "/metrics", token="listed")[0] == 200


def test_refusals_are_counted(door):
    def count():
        name = "spikeserve_rpc_duration_seconds_count"
        return sum(series(door, name, token="watchman", code="UNAUTHENTICATED", method="ModelInfer"))

    before = count()
    assert infer(door.http, "refused", "wrong")[0] == 401
    assert count() == before + 1


def chunked(body, sizes):
    pieces, at = [], 0
    for size in sizes:
        piece = body[at : at + size]
        at += size
        pieces.append(b"%x;name=value\r\n%s\r\n" % (len(piece), piece))
    return b"".join([*pieces, b"%x\r\n%s\r\n" % (len(body) - at, body[at:]), b"0\r\nTrailer: x\r\n\r\n"])


@pytest.mark.parametrize("sizes", [[], [1] * 50, [300, 7]])
def test_bodies_in_chunks(server, sizes):
    body = json.dumps(infer_body(f"chunks {len(sizes)}", start=True)).encode()
    head = f"POST {INFER} HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: Chunked\r\n\r\n".encode()
    line, answer = raw(server.http, head, chunked(body, sizes))
    assert line == b"HTTP/1.1 200 OK" and json.loads(answer)["model_name"] == "cartpole"


def test_chunks_are_bounded(server):
    head = f"POST {INFER} HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
    assert raw(server.http, head, b"400001\r\n", b" " * 0x400001)[0].split()[1] == b"413"
    assert raw(server.http, head, b"5;" + b"x" * 20_000)[0].split()[1] == b"400"
    assert raw(server.http, head, b"zz\r\n")[0].split()[1] == b"400"


@pytest.mark.parametrize(
    ("headers", "code"),
    [
        ("Transfer-Encoding: xchunked\r\nContent-Length: 2", b"501"),
        ("Transfer-Encoding: gzip, chunked", b"501"),
        ("Transfer-Encoding: identity\r\nContent-Length: 2", b"501"),
        ("Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked", b"400"),
        ("Transfer-Encoding: chunked\r\nContent-Length: 2", b"400"),
        ("Content-Length: 2\r\nContent-Encoding: gzip\r\nContent-Encoding: identity", b"415"),
    ],
)
def test_headers_that_others_read_in_another_way(server, headers, code):
    head = f"POST {INFER} HTTP/1.1\r\n{headers}\r\n\r\n".encode()
    assert raw(server.http, head, b"{}")[0].split()[1] == code


@pytest.mark.parametrize("encoding", ["GZIP", "Gzip", "x-gzip"])
def test_names_of_encodings_have_no_case(server, encoding):
    body = gzip.compress(json.dumps(infer_body(f"case {encoding}", start=True)).encode())
    assert ask(server.http, "POST", INFER, body, Content_Encoding=encoding)[0] == 200


@pytest.mark.parametrize(
    ("target", "code"),
    [
        ("http://localhost/healthz", b"200"),
        ("HTTP://127.0.0.1:9/healthz", b"200"),
        ("http://localhost", b"200"),
        ("http://evil.example/healthz", b"403"),
        ("http:///healthz", b"400"),
        ("ftp://localhost/healthz", b"400"),
    ],
)
def test_targets_in_absolute_form(server, target, code):
    assert raw(server.http, f"GET {target} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())[0].split()[1] == code


def test_changes_by_grpc_web_are_recorded_with_the_certificate(tmp_path, certificates, tokens):
    log = tmp_path / "audit.jsonl"
    flags = tls_flags(certificates, f"--tls_client_ca={certificates}/ca.pem", f"--tokens={tokens}", f"--audit_log={log}")
    with running_server(flags=flags) as addresses:
        context = ssl.create_default_context(cafile=certificates / "ca.pem")
        context.load_cert_chain(certificates / "client.pem", certificates / "client.key")
        host, _, port = addresses.http.rpartition(":")
        connection = http.client.HTTPSConnection(host, int(port), context=context, timeout=DEADLINE_SECONDS)
        headers = {"Content-Type": BINARY, "Authorization": "Bearer machine"}
        connection.request("POST", f"/{ADMIN}/ReloadPolicies", framed(b""), headers)
        assert parts(connection.getresponse().read())[1]["grpc-status"] == "0"
        connection.close()
    (line,) = [json.loads(line) for line in log.read_text().splitlines()]
    assert (line["action"], line["certificate"], line["address"]) == ("ReloadPolicies", "CN=client", "127.0.0.1")


def nested(depth):
    """Returns a body of JSON that takes long to read: many short numbers."""
    return json.dumps(infer_body("long", start=True, observation=[0] * depth)).encode()


def test_long_bodies_delay_neither_health_nor_short_ones(server):
    """While four clients send bodies that take long to read, both are answered; before, they waited for the bodies."""
    body = gzip.compress(nested(1_200_000))
    stopped = threading.Event()

    def send():
        while not stopped.is_set():
            with contextlib.suppress(TimeoutError):  # the worker has a low priority
                assert ask(server.http, "POST", INFER, body, Content_Encoding="gzip")[0] in (400, 413)

    with concurrent.futures.ThreadPoolExecutor(4) as senders:
        sending = [senders.submit(send) for _ in range(4)]
        try:
            seconds = [ask(server.http, "GET", "/healthz")[2] for _ in range(50)]
            short = [infer(server.http, f"short {i}", None)[0] for i in range(20)]
        finally:
            stopped.set()
        for done in sending:
            done.result()
    print(f"/healthz: at most {1000 * max(seconds):.0f} ms beside long bodies")
    assert short == [200] * 20


def test_bodies_are_read_on_workers(server):
    """No time is measured: the thread of the HTTP port itself uses less processor time than the bodies take."""
    pid = server.process.pid
    body = gzip.compress(nested(1_200_000))
    workers, loops = schedule_of(pid, "worker")[0], schedule_of(pid, "http", "loop")[0]
    for _ in range(5):
        ask(server.http, "POST", INFER, body, Content_Encoding="gzip")
    workers, loops = schedule_of(pid, "worker")[0] - workers, schedule_of(pid, "http", "loop")[0] - loops
    assert loops < workers / 4, (loops, workers)
