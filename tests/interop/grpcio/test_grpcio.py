"""The newest grpcio, in what the cases of the clients in other languages (cases.py) lack: limits, streams, health, reflection."""

import threading

import grpc
import pytest
from contract import call, message_class, v1
from security import OBSERVATION, POLICY, SERVING, code_of, fails_with, until
from serving import DEADLINE_SECONDS

LIST = f"/{POLICY}/ListPolicies"
OPEN = f"/{POLICY}/OpenSession"
BATCH = f"/{POLICY}/ActBatch"
STREAM = f"/{POLICY}/ActStream"
REFLECT = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo"
MESSAGE_LIMIT = 4194304


def open_session(channel):
    opened = call(channel, OPEN)(v1("OpenSessionRequest", policy="cartpole"), timeout=DEADLINE_SECONDS)
    return opened.session_id


def act_request(session, step):
    return v1("ActRequest", session_id=session, step=step, observation=OBSERVATION)


def batch_of_bytes(size):
    """Returns an ActBatchRequest of exactly `size` bytes, whose one request names an unknown session."""
    padded = v1("ActBatchRequest", requests=[v1("ActRequest", session_id="x" * (size - 10))])
    assert padded.ByteSize() == size
    return padded


def test_a_request_at_the_limit_is_answered_and_a_longer_one_refused(channel):
    batch = call(channel, BATCH)
    (result,) = batch(batch_of_bytes(MESSAGE_LIMIT), timeout=DEADLINE_SECONDS).results
    assert result.code == grpc.StatusCode.NOT_FOUND.value[0]
    for size in (MESSAGE_LIMIT + 1, 3 * MESSAGE_LIMIT):
        with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED, f"expected at most {MESSAGE_LIMIT}, received {size}"):
            batch(batch_of_bytes(size), timeout=DEADLINE_SECONDS)
    assert call(channel, LIST)(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS).policies


def test_a_thousand_streams_at_a_time_on_one_channel(server):
    """Streams beyond the limit of a connection wait in the client until others end."""
    with grpc.insecure_channel(server.grpc) as channel:
        session = open_session(channel)
        streams = [
            call(channel, STREAM)(iter([act_request(session, 0)]), timeout=DEADLINE_SECONDS) for _ in range(1000)
        ]
        assert [len(list(answers)) for answers in streams] == [1] * 1000


def test_health_check_and_watch(server):
    request = message_class("grpc.health.v1.HealthCheckRequest")
    with grpc.insecure_channel(server.grpc) as channel:
        check = call(channel, "/grpc.health.v1.Health/Check")
        assert check(request(), timeout=DEADLINE_SECONDS).status == SERVING
        assert check(request(service=POLICY), timeout=DEADLINE_SECONDS).status == SERVING
        assert code_of(check, request(service="no.such.Service"), timeout=DEADLINE_SECONDS) == grpc.StatusCode.NOT_FOUND

        drain = call(channel, "/spikeserve.v1.PolicyAdmin/Drain")
        watch = call(channel, "/grpc.health.v1.Health/Watch")(request(), timeout=DEADLINE_SECONDS)
        assert next(watch).status == SERVING
        drain(v1("DrainRequest"), timeout=DEADLINE_SECONDS)
        assert next(watch).status != SERVING
        drain(v1("DrainRequest", cancel=True), timeout=DEADLINE_SECONDS)
        assert next(watch).status == SERVING
        watch.cancel()
        unserved = call(channel, "/grpc.health.v1.Health/Watch")(
            request(service="no.such.Service"), timeout=DEADLINE_SECONDS
        )
        assert next(unserved).status == 3  # SERVICE_UNKNOWN
        unserved.cancel()


def test_reflection_describes_each_service(channel):
    request = message_class("grpc.reflection.v1.ServerReflectionRequest")
    reflect = call(channel, REFLECT)
    (listed,) = reflect(iter([request(list_services="")]), timeout=DEADLINE_SECONDS)
    names = [service.name for service in listed.list_services_response.service]
    assert POLICY in names
    symbols = [request(file_containing_symbol=name) for name in names if "v1alpha" not in name]
    for answer in reflect(iter(symbols), timeout=DEADLINE_SECONDS):
        assert answer.file_descriptor_response.file_descriptor_proto, answer
    unknown = [
        request(file_containing_symbol="no.such.Symbol"),
        request(file_by_filename="nothing.proto"),
        request(all_extension_numbers_of_type="nothing"),
        request(),
    ]
    codes = [answer.error_response.error_code for answer in reflect(iter(unknown), timeout=DEADLINE_SECONDS)]
    assert codes == [5, 5, 5, 3]  # NOT_FOUND, and INVALID_ARGUMENT for no question at all
    imports = request(file_by_filename="spikeserve/v1/policy_admin.proto")
    (described,) = reflect(iter([imports]), timeout=DEADLINE_SECONDS)
    assert len(described.file_descriptor_response.file_descriptor_proto) == 3


def test_reflection_of_older_clients_lists_the_same_services(channel):
    request = message_class("grpc.reflection.v1.ServerReflectionRequest")(list_services="").SerializeToString()
    answers = []
    for path in (REFLECT, REFLECT.replace(".v1.", ".v1alpha.")):  # with the same messages under another name
        answers += channel.stream_stream(path)(iter([request]), timeout=DEADLINE_SECONDS)
    assert len(answers) == 2
    assert answers[0] == answers[1]


def test_connections_that_come_and_go(server):
    def connect():
        with grpc.insecure_channel(server.grpc, [("grpc.use_local_subchannel_pool", 1)]) as own:
            answered.append(open_session(own))

    answered = []
    threads = [threading.Thread(target=connect) for _ in range(64)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    until(lambda: len(answered) == len(threads))


@pytest.mark.parametrize("path", [f"/{POLICY}/NoSuchMethod", "/no.such.Service/Method", "/", "/x"])
def test_an_unknown_method_is_unimplemented(channel, path):
    assert code_of(channel.unary_unary(path), b"", timeout=DEADLINE_SECONDS) == grpc.StatusCode.UNIMPLEMENTED


def test_a_message_that_cannot_be_parsed_ends_its_call_alone(channel):
    with pytest.raises(grpc.RpcError) as refused:
        channel.unary_unary(f"/{POLICY}/Act")(b"\xff\xff\xff", timeout=DEADLINE_SECONDS)
    # gRPC's C++ server answers UNIMPLEMENTED, those of Go and Java INTERNAL.
    assert refused.value.code() in {
        grpc.StatusCode.INTERNAL,
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.UNIMPLEMENTED,
    }
    assert call(channel, LIST)(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS).policies


def test_metadata_that_is_too_large_ends_its_call_alone(channel):
    with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED):
        call(channel, LIST)(v1("ListPoliciesRequest"), metadata=[("x-text", "x" * 20_000)], timeout=DEADLINE_SECONDS)
    assert call(channel, LIST)(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS).policies


def test_a_response_is_not_compressed_without_need(channel):
    _, finished = call(channel, LIST).with_call(v1("ListPoliciesRequest"), timeout=DEADLINE_SECONDS)
    encodings = [value for key, value in finished.initial_metadata() if key == "grpc-encoding"]
    assert encodings in ([], ["identity"])
