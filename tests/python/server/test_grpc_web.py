"""gRPC-Web: raw requests, and pages of other sites in headless Chromium. tests/interop has a client of others."""

import base64
import contextlib
import http.client
import http.server
import subprocess
import threading

import grpc
import pytest
from security import ADMIN, POLICY
from serving import DEADLINE_SECONDS, http_call, message_class, running_server

BINARY, TEXT = "application/grpc-web+proto", "application/grpc-web-text+proto"


def framed(message, flag=0):
    return bytes([flag]) + len(message).to_bytes(4, "big") + message


def post(server, path, body, content_type=BINARY, **headers):
    """Returns the code, the headers and the body of the answer."""
    return http_call(server.http, "POST", path, body, Content_Type=content_type, **headers)


def parts(body):
    """Returns the message of an answer, None if there is none, and its trailers."""
    message, trailers = None, None
    while body:
        length = int.from_bytes(body[1:5], "big")
        content, flag, body = body[5 : 5 + length], body[0], body[5 + length :]
        if flag == 0:
            message = content
        else:
            trailers = dict(
                line.split(": ", 1) for line in content.decode().split("\r\n") if line
            )
    return message, trailers


def status(server, path, body, **arguments):
    """Returns the code of a call as gRPC has it, and its message."""
    code, headers, answer = post(server, path, body, **arguments)
    assert code == 200
    assert headers["Content-Type"] == arguments.get("content_type", BINARY)
    if arguments.get("content_type") == TEXT:
        answer = base64.b64decode(answer, validate=True)
    trailers = parts(answer)[1]
    number = int(trailers["grpc-status"])
    name = next(status.name for status in grpc.StatusCode if status.value[0] == number)
    return name, trailers.get("grpc-message", "")


def test_the_text_form_is_the_binary_one_in_base64(server):
    request = message_class(server.channel, "spikeserve.v1.OpenSessionRequest")(
        policy="cartpole"
    ).SerializeToString()
    response = message_class(server.channel, "spikeserve.v1.OpenSessionResponse")
    path = f"/{POLICY}/OpenSession"
    code, headers, body = post(
        server, path, base64.b64encode(framed(request)), TEXT, Accept=TEXT
    )
    assert (code, headers["Content-Type"]) == (200, TEXT)
    message, trailers = parts(base64.b64decode(body, validate=True))
    assert trailers == {"grpc-status": "0"}
    assert response.FromString(message).session_id


@pytest.mark.parametrize(
    ("path", "body", "code", "text"),
    [
        (f"/{POLICY}/Fly", framed(b""), "UNIMPLEMENTED", "expected a unary method"),
        (
            f"/{POLICY}/ActStream",
            framed(b""),
            "UNIMPLEMENTED",
            "expected a unary method",
        ),
        ("/metrics", framed(b""), "UNIMPLEMENTED", "expected a unary method"),
        (f"/{POLICY}/Act", b"", "INVALID_ARGUMENT", "received 0 bytes"),
        (
            f"/{POLICY}/Act",
            framed(b"abc")[:-1],
            "INVALID_ARGUMENT",
            "expected one message of 3 bytes, received 2",
        ),
        (
            f"/{POLICY}/Act",
            framed(b"") * 2,
            "INVALID_ARGUMENT",
            "expected one message of 0 bytes, received 5",
        ),
        (
            f"/{POLICY}/Act",
            framed(b"abc", flag=1),
            "UNIMPLEMENTED",
            "expected a message that is not compressed",
        ),
        (
            f"/{POLICY}/Act",
            framed(b"\xff\xff"),
            "INTERNAL",
            "received bytes that are none",
        ),
    ],
)
def test_what_is_no_call_is_refused(server, path, body, code, text):
    name, message = status(server, path, body)
    assert (name, text in message) == (code, True), message
    assert status(server, path, base64.b64encode(body), content_type=TEXT) == (
        name,
        message,
    )


def test_base64_is_checked(server):
    assert status(server, f"/{POLICY}/Act", b"!!!!", content_type=TEXT) == (
        "INVALID_ARGUMENT",
        "body: expected base64",
    )


def test_another_content_type_is_no_call(server):
    assert (
        post(server, f"/{POLICY}/ListPolicies", framed(b""), "application/grpc-webx")[0]
        == 405
    )


def test_deadlines(server):
    path = f"/{POLICY}/ListPolicies"
    assert status(server, path, framed(b""), grpc_timeout="30S")[0] == "OK"
    assert (
        status(server, path, framed(b""), grpc_timeout="0n")[0] == "DEADLINE_EXCEEDED"
    )
    name, message = status(server, path, framed(b""), grpc_timeout="soon")
    assert name == "INVALID_ARGUMENT" and message.startswith("grpc-timeout: expected")


def test_a_body_has_the_length_of_a_message(server):
    limit = 4 << 20
    assert status(server, f"/{POLICY}/ListPolicies", framed(b"\x7a" * 0))[0] == "OK"
    code, _, body = post(server, f"/{POLICY}/Act", bytes(limit + 6))
    assert code == 413 and b"--max_message_bytes" in body


def test_tokens_roles_and_rates_count(tokens):
    with running_server(flags=[f"--tokens={tokens}"]) as server:
        path = f"/{POLICY}/ListPolicies"
        assert status(server, path, framed(b""))[0] == "UNAUTHENTICATED"
        assert (
            status(server, path, framed(b""), Authorization="Bearer agent")[0] == "OK"
        )
        path = f"/{ADMIN}/ListHistory"
        assert (
            status(server, path, framed(b""), Authorization="Bearer agent")[0]
            == "PERMISSION_DENIED"
        )


class Site(http.server.BaseHTTPRequestHandler):
    """An empty page of another site."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def site():
    """Yields the origin of another site."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Site) as pages:
        threading.Thread(target=pages.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{pages.server_port}"
        pages.shutdown()


# Calls a method from a page, and keeps what the page learns of the answer.
CALL = """
  window.answer = null;
  fetch('http://%s/%s/ListPolicies', {
    method: 'POST',
    headers: {'content-type': 'application/grpc-web+proto', 'x-grpc-web': '1'},
    body: new Uint8Array(5),
  }).then((response) => response.arrayBuffer())
    .then((body) => { window.answer = new TextDecoder().decode(body); })
    .catch((error) => { window.answer = String(error); });
"""


def test_pages_of_allowed_origins_call(server, browser):
    with site() as allowed, site() as stranger:
        with running_server(
            flags=[f"--http_origins=https://robots.example,{allowed}"]
        ) as open_server:
            answers = {}
            for origin in (allowed, stranger):
                browser.driver.get(origin)
                browser.driver.execute_script(CALL % (open_server.http, POLICY))
                answers[origin] = browser.wait_for("window.answer", "an answer")
            assert (
                "cartpole" in answers[allowed] and "grpc-status: 0" in answers[allowed]
            )
            assert answers[stranger] == "TypeError: Failed to fetch"
        browser.driver.get(allowed)
        browser.driver.execute_script(CALL % (server.http, POLICY))
        assert (
            browser.wait_for("window.answer", "an answer")
            == "TypeError: Failed to fetch"
        )


def test_cross_origin_headers():
    origin = "https://robots.example"
    with running_server(flags=[f"--http_origins={origin}"]) as server:
        path = f"/{POLICY}/ListPolicies"
        code, headers, _ = post(server, path, framed(b""), Origin=origin)
        assert (code, headers["Access-Control-Allow-Origin"], headers["Vary"]) == (
            200,
            origin,
            "Origin",
        )
        assert "grpc-status" in headers["Access-Control-Expose-Headers"]
        code, headers, _ = post(
            server, path, framed(b""), Origin="https://robots.example.evil"
        )
        assert (code, headers["Access-Control-Allow-Origin"]) == (403, None)
        assert (
            post(
                server,
                "/v2/models/cartpole/infer",
                b"{}",
                "application/json",
                Origin=origin,
            )[0]
            == 400
        )
        for asking, expected in ((origin, 200), ("https://evil.example", 403)):
            connection = http.client.HTTPConnection(
                server.http, timeout=DEADLINE_SECONDS
            )
            connection.request(
                "OPTIONS",
                path,
                headers={"Origin": asking, "Access-Control-Request-Method": "POST"},
            )
            response = connection.getresponse()
            assert (
                response.status,
                response.headers["Access-Control-Allow-Origin"] == asking,
            ) == (expected, expected == 200)
            connection.close()


@pytest.mark.parametrize(
    "origins",
    [
        "*",
        "robots.example",
        "https://robots.example/",
        "https://Robots.example",
        "null",
    ],
)
def test_origins_are_checked_at_start(origins):
    with (
        pytest.raises(AssertionError, match="received ''"),
        running_server(flags=[f"--http_origins={origins}"], log=subprocess.DEVNULL),
    ):
        pass
