"""The newest grpcio over TLS, mutual TLS and a unix socket."""

import grpc
from contract import call, v1
from security import OBSERVATION, POLICY, code_of, credentials
from serving import DEADLINE_SECONDS, running_server


def play(channel):
    """Makes a unary call, a large one and a stream of calls. Asserts on their answers."""
    opened = call(channel, f"/{POLICY}/OpenSession")(
        v1("OpenSessionRequest", policy="cartpole"), timeout=DEADLINE_SECONDS
    )
    batch = [v1("ActRequest", session_id="x" * 3000)] * 1000  # 3 MB
    answer = call(channel, f"/{POLICY}/ActBatch")(
        v1("ActBatchRequest", requests=batch), timeout=DEADLINE_SECONDS
    )
    assert len(answer.results) == len(batch)
    requests = [
        v1("ActRequest", session_id=opened.session_id, step=step, observation=OBSERVATION)
        for step in range(100)
    ]
    answers = call(channel, f"/{POLICY}/ActStream")(iter(requests), timeout=DEADLINE_SECONDS)
    assert [answer.step for answer in answers] == list(range(100))


UNLIMITED = [("grpc.max_receive_message_length", -1)]


def test_tls(tls_server, tls_credentials):
    with grpc.secure_channel(tls_server.grpc, tls_credentials, UNLIMITED) as channel:
        play(channel)


def test_tls_to_a_plain_port_fails(server, tls_credentials):
    with grpc.secure_channel(server.grpc, tls_credentials) as channel:
        assert code_of(play, channel) == grpc.StatusCode.UNAVAILABLE


def test_mutual_tls(mutual_tls_server, certificates):
    own = credentials(certificates, client=True)
    with grpc.secure_channel(mutual_tls_server.grpc, own, UNLIMITED) as channel:
        play(channel)


def test_unix_socket(tmp_path):
    path = tmp_path / "spikeserve.sock"
    with running_server(flags=[f"--listen=unix:{path}"]) as started:
        assert started.grpc == f"unix:{path}"
        with grpc.insecure_channel(started.grpc, UNLIMITED) as channel:
            play(channel)
