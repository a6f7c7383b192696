"""nginx, HAProxy and Envoy in front of the server, with the configurations of deploy/. The proxies listen on unix sockets."""

import contextlib
import pathlib
import threading

import grpc
import pytest
from contract import call, message_class, v1
from deployed_proxies import PROXIES, running
from security import OBSERVATION, POLICY, SERVING, code_of, credentials, fails_with, until
from serving import DEADLINE_SECONDS, running_server


def in_front(name, path, server, certificates):
    """Runs a proxy that listens on path/proxy.sock and asks the server."""
    host, _, port = server.grpc.rpartition(":")
    file, parts = {
        "nginx": (
            "spikeserve.conf",
            {"127.0.0.1:50051": server.grpc, "listen 443": f"listen unix:{path}/proxy.sock"},
        ),
        "haproxy": (
            "haproxy.cfg",
            {
                "127.0.0.1:50051": server.grpc,
                "port 9464": f"port {server.http.rpartition(':')[2]}",
                "bind :443": f"bind unix@{path}/proxy.sock",
            },
        ),
        "envoy": (
            "envoy.yaml",
            {
                "address: 127.0.0.1, port_value: 50051": f"address: {host}, port_value: {port}",
                "socket_address: {address: 0.0.0.0, port_value: 443}": f"pipe: {{path: {path}/proxy.sock}}",
            },
        ),
    }[name]
    return running(name, file, path, certificates, parts)


@pytest.fixture(scope="module", params=PROXIES)
def channel(request, server, certificates, tmp_path_factory):
    """A channel to the server through a proxy, over TLS."""
    path: pathlib.Path = tmp_path_factory.mktemp("proxy")
    options = [
        ("grpc.ssl_target_name_override", "localhost"),
        ("grpc.default_authority", "localhost"),
        ("grpc.max_receive_message_length", -1),
        ("grpc.use_local_subchannel_pool", 1),
    ]
    with in_front(request.param, path, server, certificates):
        until((path / "proxy.sock").exists)
        target = f"unix:{path}/proxy.sock"
        with grpc.secure_channel(target, credentials(certificates), options) as opened:
            until(lambda: healthy(opened))  # HAProxy checks the server first
            yield opened


def healthy(channel):
    request = message_class("grpc.health.v1.HealthCheckRequest")()
    try:
        answer = call(channel, "/grpc.health.v1.Health/Check")(request, timeout=DEADLINE_SECONDS)
    except grpc.RpcError:
        return False
    return answer.status == SERVING


def open_session(channel):
    request = v1("OpenSessionRequest", policy="cartpole")
    return call(channel, f"/{POLICY}/OpenSession")(request, timeout=DEADLINE_SECONDS).session_id


def test_unary_calls(channel):
    list_policies = call(channel, f"/{POLICY}/ListPolicies")
    futures = [
        list_policies.future(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS)
        for _ in range(200)
    ]
    assert all(future.result().policies for future in futures)


def test_a_large_call(channel):
    requests = [v1("ActRequest", session_id="x" * 3000)] * 1000  # 3 MB
    answer = call(channel, f"/{POLICY}/ActBatch")(
        v1("ActBatchRequest", requests=requests), timeout=DEADLINE_SECONDS
    )
    assert len(answer.results) == len(requests)


def test_ping_pong(channel):
    session = open_session(channel)
    answered = []

    def requests():
        for step in range(50):
            assert len(answered) == step  # the proxy holds no answer back
            yield v1("ActRequest", session_id=session, step=step, observation=OBSERVATION)
            until(lambda: len(answered) == step + 1)  # noqa: B023

    answers = call(channel, f"/{POLICY}/ActStream")(requests(), timeout=DEADLINE_SECONDS)
    for answer in answers:
        answered.append(answer.step)
    assert answered == list(range(50))


def test_errors_keep_their_status_and_message(channel):
    with fails_with(grpc.StatusCode.NOT_FOUND, whole='session_id: expected an open session, received "100%"'):
        call(channel, f"/{POLICY}/CloseSession")(
            v1("CloseSessionRequest", session_id="100%"), timeout=DEADLINE_SECONDS
        )


def test_a_cancelled_stream_leaves_the_session_usable(channel):
    session = open_session(channel)
    act = v1("ActRequest", session_id=session, step=0, observation=OBSERVATION)

    cancelled = threading.Event()

    def requests():
        yield act
        cancelled.wait(DEADLINE_SECONDS)

    answers = call(channel, f"/{POLICY}/ActStream")(requests(), timeout=DEADLINE_SECONDS)
    assert next(answers).step == 0
    answers.cancel()
    cancelled.set()
    assert open_session(channel)


def test_a_deadline_passes_through(channel):
    watch = call(channel, "/grpc.health.v1.Health/Watch")(
        message_class("grpc.health.v1.HealthCheckRequest")(), timeout=0.5
    )
    assert next(watch).status == SERVING
    assert code_of(next, watch) == grpc.StatusCode.DEADLINE_EXCEEDED


@pytest.mark.parametrize("proxy", PROXIES)
def test_a_server_that_has_stopped_is_unavailable(proxy, certificates, tmp_path):
    with contextlib.ExitStack() as stack:
        with running_server() as server:
            stack.enter_context(in_front(proxy, tmp_path, server, certificates))
            until((tmp_path / "proxy.sock").exists)
            options = [
                ("grpc.ssl_target_name_override", "localhost"),
                ("grpc.default_authority", "localhost"),
            ]
            channel = stack.enter_context(
                grpc.secure_channel(
                    f"unix:{tmp_path}/proxy.sock", credentials(certificates), options
                )
            )
            until(lambda: healthy(channel))
        with fails_with(grpc.StatusCode.UNAVAILABLE):
            call(channel, f"/{POLICY}/ListPolicies")(
                v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS
            )
