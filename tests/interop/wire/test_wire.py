"""What a client of gRPC does not send, or does not show: frames as they are on the wire."""

import base64
import contextlib
import socket
import ssl
import struct
import time

import grpc
import h2.connection
import h2.exceptions
import pytest
from contract import call, message_class, v1
from http2_client import Http2Client, framed, headers
from security import OBSERVATION, POLICY, SERVING, credentials, tls_flags
from serving import DEADLINE_SECONDS, running_server

LIST = f"/{POLICY}/ListPolicies"
OPEN = f"/{POLICY}/OpenSession"
STREAM = f"/{POLICY}/ActStream"
HEALTH = "/grpc.health.v1.Health/Check"
EMPTY = v1("ListPoliciesRequest")
OK, INVALID_ARGUMENT, INTERNAL, UNIMPLEMENTED, DEADLINE_EXCEEDED = (
    getattr(grpc.StatusCode, name).value[0]
    for name in ("OK", "INVALID_ARGUMENT", "INTERNAL", "UNIMPLEMENTED", "DEADLINE_EXCEEDED")
)
RESOURCE_EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]


@pytest.fixture
def client(server):
    with Http2Client(server.grpc) as connected:
        yield connected


def serves(client):
    """Returns true if the connection still serves calls."""
    (answer,) = client.call(HEALTH, b"").messages()
    return message_class("grpc.health.v1.HealthCheckResponse").FromString(answer).status == SERVING


def open_session(client):
    (answer,) = client.call(OPEN, v1("OpenSessionRequest", policy="cartpole")).messages()
    return message_class("spikeserve.v1.OpenSessionResponse").FromString(answer).session_id


def act_request(session, step):
    return v1("ActRequest", session_id=session, step=step, observation=OBSERVATION)


def test_an_answer_has_headers_one_message_and_trailers(client):
    answer = client.call(LIST, EMPTY)
    assert answer.headers[":status"] == "200"
    assert answer.headers["content-type"] in ("application/grpc", "application/grpc+proto")
    assert len(answer.messages()) == 1
    assert answer.trailers["grpc-status"] == "0"
    assert answer.ended


def test_an_error_is_one_block_of_headers(client):
    answer = client.call(f"/{POLICY}/CloseSession", v1("CloseSessionRequest", session_id="x"))
    assert answer.headers[":status"] == "200"
    assert answer.headers["content-type"].startswith("application/grpc")
    assert answer.grpc_status == grpc.StatusCode.NOT_FOUND.value[0]
    assert not answer.data
    assert "grpc-status" in answer.headers  # Trailers-Only


@pytest.mark.parametrize(
    "content_type", ["application/grpc", "application/grpc+proto", "application/grpc;charset=utf-8"]
)
def test_content_types_of_grpc_are_served(client, content_type):
    assert client.call(LIST, EMPTY, content_type=content_type).grpc_status == OK


@pytest.mark.parametrize(
    "content_type", ["application/json", "application/grpc-web", "application/grpc+json", "application/grpcx", "", None]
)
def test_another_content_type_is_415(client, content_type):
    answer = client.call(LIST, EMPTY, content_type=content_type)
    assert answer.headers[":status"] == "415"
    assert serves(client)


@pytest.mark.parametrize("method", ["GET", "PUT", "HEAD", "DELETE", "OPTIONS"])
def test_another_http_method_is_405(client, method):
    stream = client.begin(headers(LIST, method=method), end=True)
    answer = client.wait(stream)
    assert answer.headers[":status"] == "405"
    assert answer.headers["allow"] == "POST"
    assert serves(client)


def test_a_call_without_te_is_served(client):
    """`te: trailers` detects proxies that drop trailers. Of the known servers only gRPC's in C++ insists on it."""
    answer = client.call(LIST, EMPTY, te=None)
    assert answer.grpc_status == OK


def test_an_unknown_encoding_is_unimplemented_and_names_the_known_ones(client):
    answer = client.call(LIST, EMPTY, grpc_encoding="snappy")
    assert answer.grpc_status == UNIMPLEMENTED
    assert {**answer.headers, **answer.trailers}["grpc-accept-encoding"] == "identity,gzip"
    assert serves(client)


def test_a_compressed_message_without_an_encoding_is_internal(client):
    stream = client.begin(headers(LIST))
    client.send(stream, framed(b"xx", compressed=1), end=True)
    answer = client.wait(stream)
    assert answer.grpc_status == INTERNAL
    assert serves(client)


def test_identity_may_be_named(client):
    assert client.call(LIST, EMPTY, grpc_encoding="identity").grpc_status == OK


@pytest.mark.parametrize("unit", ["H", "M", "S", "m", "u", "n"])
def test_every_unit_of_a_timeout_is_understood(client, unit):
    assert client.call(LIST, EMPTY, grpc_timeout=f"99999999{unit}").grpc_status == OK


@pytest.mark.parametrize("timeout", ["1", "S", "1x", "-1S", "999999999S", "1.5S"])
def test_a_timeout_that_cannot_be_read_leaves_the_connection_usable(client, timeout):
    answer = client.call(LIST, EMPTY, grpc_timeout=timeout)
    assert answer.grpc_status == INVALID_ARGUMENT
    assert f'expected 1 to 8 digits and one of H, M, S, m, u, n, received "{timeout}"' in answer.grpc_message
    assert serves(client)


def test_the_server_ends_a_call_at_its_deadline(client):
    stream = client.begin(headers(STREAM, grpc_timeout="200m"))
    answer = client.wait(stream)
    assert answer.grpc_status == DEADLINE_EXCEEDED
    assert serves(client)


def test_the_server_ends_a_watch_at_its_deadline(client):
    stream = client.begin(headers("/grpc.health.v1.Health/Watch", grpc_timeout="200m"))
    client.send(stream, framed(b""), end=True)
    answer = client.wait(stream)
    assert len(answer.messages()) == 1
    assert answer.grpc_status == DEADLINE_EXCEEDED


@pytest.mark.parametrize("padded", [True, False])
def test_binary_metadata_comes_padded_or_not(client, padded):
    value = base64.b64encode(bytes(range(256))).decode()
    assert client.call(LIST, EMPTY, x_bytes_bin=value if padded else value.rstrip("=")).grpc_status == OK


def test_a_message_in_frames_of_one_byte(client):
    stream = client.begin(headers(OPEN))
    data = framed(v1("OpenSessionRequest", policy="cartpole"))
    for i in range(len(data)):
        client.send(stream, data[i : i + 1], end=i == len(data) - 1)
    assert client.wait(stream).grpc_status == OK


def test_many_messages_in_one_frame_and_padding(client):
    session = open_session(client)
    stream = client.begin(headers(STREAM))
    requests = b"".join(framed(act_request(session, step)) for step in range(50))
    client.send(stream, requests, end=True, pad_length=255)
    answer = client.wait(stream)
    assert answer.grpc_status == OK
    response = message_class("spikeserve.v1.ActResponse")
    assert [response.FromString(message).step for message in answer.messages()] == list(range(50))


def test_an_end_after_the_last_message_as_an_empty_frame(client):
    stream = client.begin(headers(LIST))
    client.send(stream, framed(EMPTY))
    client.send(stream, b"", end=True)
    assert client.wait(stream).grpc_status == OK


@pytest.mark.parametrize("ends_at_once", [True, False])
def test_a_refused_call_keeps_its_status(addresses, ends_at_once):
    with Http2Client(addresses.grpc) as client:
        stream = client.begin(headers(LIST))
        client.send(stream, framed(EMPTY), end=ends_at_once)
        if not ends_at_once:
            client.send(stream, b"", end=True)
        assert client.wait(stream).grpc_status == grpc.StatusCode.UNAUTHENTICATED.value[0]


def test_an_end_in_the_middle_of_a_message_is_an_error(client):
    stream = client.begin(headers(OPEN))
    client.send(stream, framed(v1("OpenSessionRequest", policy="cartpole"))[:-3], end=True)
    answer = client.wait(stream)
    assert answer.grpc_status == INTERNAL
    assert serves(client)


def test_a_unary_call_without_a_message_is_an_error(client):
    stream = client.begin(headers(OPEN), end=True)
    answer = client.wait(stream)
    assert answer.grpc_status != OK
    assert serves(client)


def test_a_length_beyond_the_limit_is_refused_before_its_bytes_arrive(client):
    stream = client.begin(headers(OPEN))
    client.send(stream, b"\x00\xff\xff\xff\xff" + b"x" * 1000)
    assert client.wait(stream).grpc_status == RESOURCE_EXHAUSTED
    assert serves(client)


def test_an_early_answer_does_not_break_the_connection(client):
    """The client is still sending when the server refuses; what it sends later is discarded."""
    stream = client.begin(headers("/no.such.Service/Method"))
    answer = client.wait(stream, until=lambda answer: answer.headers or answer.reset is not None)
    assert answer.grpc_status == UNIMPLEMENTED
    client.wait(stream)
    for _ in range(5):
        assert serves(client)


def test_an_answer_waits_for_the_window_of_its_stream(server):
    with Http2Client(server.grpc, initial_window=0) as client:
        stream = client.begin(headers(LIST))
        client.send(stream, framed(EMPTY), end=True)
        client.wait(stream, until=lambda answer: answer.headers)
        client.wait_for_ping()
        assert not client.answers[stream].data
        for _ in range(10):
            client.h2.increment_flow_control_window(7, stream)
        client.h2.increment_flow_control_window(1 << 20, stream)
        client.flush()
        answer = client.wait(stream)
    assert answer.grpc_status == OK
    assert len(answer.messages()) == 1


def test_an_answer_waits_for_the_window_of_its_connection(server):
    request = v1("ActBatchRequest", requests=[v1("ActRequest", session_id="x" * 50)] * 1000)
    with Http2Client(server.grpc, initial_window=1 << 20, grant_windows=False) as client:
        stream = client.begin(headers(f"/{POLICY}/ActBatch"))
        client.send(stream, framed(request), end=True)
        client.wait(stream, until=lambda answer: len(answer.data) == 65535)
        client.wait_for_ping()
        assert len(client.answers[stream].data) == 65535
        client.h2.increment_flow_control_window(1 << 20)
        client.flush()
        answer = client.wait(stream)
    assert answer.grpc_status == OK
    (message,) = answer.messages()
    assert len(message_class("spikeserve.v1.ActBatchResponse").FromString(message).results) == 1000


def test_a_cancelled_call_leaves_the_others_alone(client):
    session = open_session(client)
    cancelled, kept = client.begin(headers(STREAM)), client.begin(headers(STREAM))
    for stream in (cancelled, kept):
        client.send(stream, framed(act_request(session, 0)))
        client.wait(stream, until=lambda answer: answer.messages())
    client.h2.reset_stream(cancelled, error_code=8)
    client.send(kept, framed(act_request(session, 1)), end=True)
    answer = client.wait(kept)
    assert answer.grpc_status == OK
    assert len(answer.messages()) == 2


def test_the_server_answers_pings(client):
    client.wait_for_ping()
    assert serves(client)


def test_a_draining_server_sends_goaway_finishes_the_call_and_closes():
    with running_server() as started, Http2Client(started.grpc) as client:
        session = open_session(client)
        stream = client.begin(headers(STREAM))
        client.send(stream, framed(act_request(session, 0)))
        client.wait(stream, until=lambda answer: answer.messages())
        started.process.terminate()
        answer = client.wait(stream)
        assert answer.grpc_status == grpc.StatusCode.UNAVAILABLE.value[0]
        client.wait_closed()
    assert client.goaway == 0


def test_a_tenant_has_a_budget_of_its_own(tokens):
    flags = [f"--tokens={tokens}", f"--max_tenant_bytes={5 << 20}"]
    incomplete = b"\x00\x00\x30\x00\x00" + b"x" * (2 << 20)  # 2 of 3 MiB
    with running_server(flags=flags) as started, contextlib.ExitStack() as connections:

        def begin(token):
            """Sends a part of a request on a new connection, and waits until the server has read it.

            Returns the connection and its stream.
            """
            client = connections.enter_context(Http2Client(started.grpc))
            stream = client.begin(headers(OPEN, authorization=f"Bearer {token}"))
            with contextlib.suppress(h2.exceptions.StreamClosedError):  # the refusal came first
                client.send(stream, incomplete)
            client.wait_for_ping()
            return client, stream

        begin("agent")
        begin("agent")
        client, stream = begin("agent")
        assert client.wait(stream).grpc_status == RESOURCE_EXHAUSTED
        client, _ = begin("rival")
        stream = client.begin(headers(LIST, authorization="Bearer rival"))
        client.send(stream, framed(EMPTY), end=True)
        assert client.wait(stream).grpc_status == OK


def test_a_client_that_resets_its_tls_connection_does_not_end_the_server(certificates):
    """OpenSSL writes in a way that raises SIGPIPE; no HTTP library has switched the signal off here."""
    flags = [*tls_flags(certificates), "--http_listen="]
    context = ssl.create_default_context(cafile=certificates / "ca.pem")
    context.set_alpn_protocols(["h2"])
    with running_server(flags=flags) as started:
        host, port = started.grpc.rsplit(":", 1)
        for i in range(40):
            plain = socket.create_connection((host, int(port)))
            secured = context.wrap_socket(plain, server_hostname="localhost")
            peer = h2.connection.H2Connection()
            peer.initiate_connection()
            for _ in range(80):
                stream = peer.get_next_available_stream_id()
                peer.send_headers(stream, headers(LIST))
                peer.send_data(stream, framed(EMPTY), end_stream=True)
            linger = struct.pack("ii", 1, 0)
            secured.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            secured.sendall(peer.data_to_send())
            time.sleep(i * 1e-4)  # the reset has to arrive while the server is answering
            secured.shutdown(socket.SHUT_WR)  # only a reset after this raises the signal
            secured.close()
        with grpc.secure_channel(started.grpc, credentials(certificates)) as channel:
            list_policies = call(channel, LIST)
            assert list_policies(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS).policies
