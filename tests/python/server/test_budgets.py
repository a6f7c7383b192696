"""What one caller sends is bounded: its memory, and how long other callers wait for it."""

import concurrent.futures
import os
import threading

import grpc
import pytest
from security import OBSERVATION, POLICY, fails_with, service_with
from serving import DEADLINE_SECONDS, message_class, running_server

from tests.attacks.process import MEGABYTE, Process

ITEMS_MOST = 1024
REFUSED = 1000
REFUSED_CALLERS = 20


@pytest.fixture(scope="module")
def addresses(tokens):
    """Starts a server with one loop, so that all calls meet in it."""
    with running_server(flags=[f"--tokens={tokens}", "--loops=1"]) as started:
        yield started


def raw_call(addresses, method, body, token):
    """Sends bytes as the request of a method. Returns the status code."""
    options = [("grpc.use_local_subchannel_pool", 1)]  # a connection for each call
    with grpc.insecure_channel(addresses.grpc, options) as channel:
        call = channel.unary_unary(method)
        try:
            call(
                body,
                metadata=[("authorization", f"Bearer {token}")],
                timeout=4 * DEADLINE_SECONDS,
            )
        except grpc.RpcError as error:
            return error.code()
    return grpc.StatusCode.OK


def peak_of(addresses, count, *call):
    """Makes `count` calls at once. Returns their codes and the memory that they took at most."""
    process = Process(addresses.process.pid)
    idle = process.memory()
    process.reset_peak()
    codes = []
    threads = [
        threading.Thread(target=lambda: codes.append(raw_call(addresses, *call)))
        for _ in range(count)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return codes, process.peak() - idle


def test_long_requests_with_a_wrong_token_occupy_no_memory(addresses):
    body = os.urandom(MEGABYTE) * 60
    codes, peak = peak_of(addresses, 20, f"/{POLICY}/OpenSession", body, "wrong")
    # gRPC's client reports what it notices first: the answer, or that the server reads no further.
    assert set(codes) <= {grpc.StatusCode.UNAUTHENTICATED, grpc.StatusCode.UNAVAILABLE}
    assert peak < 40 * MEGABYTE


def test_a_thousand_refused_requests_occupy_no_memory(addresses):
    body = os.urandom(MEGABYTE // 2)  # all of them together are 500 MB
    process = Process(addresses.process.pid)
    idle = process.memory()
    process.reset_peak()

    def refused(_):
        with grpc.insecure_channel(addresses.grpc, [("grpc.use_local_subchannel_pool", 1)]) as channel:
            call = channel.unary_unary(f"/{POLICY}/OpenSession")
            metadata = [("authorization", "Bearer wrong")]
            # All callers of a channel wait for their refusals at once.
            calls = [
                call.future(body, metadata=metadata, timeout=10 * DEADLINE_SECONDS)
                for _ in range(REFUSED // REFUSED_CALLERS)
            ]
            return [each.code() for each in calls]

    with concurrent.futures.ThreadPoolExecutor(REFUSED_CALLERS) as callers:
        codes = sum(callers.map(refused, range(REFUSED_CALLERS)), [])
    assert len(codes) == REFUSED
    assert set(codes) <= {grpc.StatusCode.UNAUTHENTICATED, grpc.StatusCode.UNAVAILABLE}
    growth = process.peak() - idle
    print(f"{REFUSED} refused requests of 512 KiB: at most {growth / MEGABYTE:.1f} MB")
    assert growth < 400 * MEGABYTE


@pytest.mark.parametrize(
    "method",
    [f"/{POLICY}/ActBatch", "/inference.GRPCInferenceService/ModelInfer"],
)
def test_a_request_of_empty_elements_takes_four_times_its_size(addresses, method):
    tags = {f"/{POLICY}/ActBatch": b"\x0a\x00"}
    body = tags.get(method, b"\x2a\x00") * (2 * MEGABYTE - 512)
    codes, peak = peak_of(addresses, 4, method, body, "agent")
    assert codes == [grpc.StatusCode.INVALID_ARGUMENT] * 4
    assert peak < 4 * 4 * len(body)


@pytest.mark.parametrize(
    ("method", "list_of", "empty"),
    [
        (f"/{POLICY}/ActBatch", "requests", b"\x0a\x00"),
        ("/inference.GRPCInferenceService/ModelInfer", "inputs", b"\x2a\x00"),
    ],
)
def test_empty_items_are_refused_before_they_are_parsed(addresses, method, list_of, empty):
    call = addresses.channel.unary_unary(method)
    with fails_with(grpc.StatusCode.INVALID_ARGUMENT) as refused:
        call(
            empty * ITEMS_MOST,
            metadata=[("authorization", "Bearer agent")],
            timeout=DEADLINE_SECONDS,
        )
    expected = f"{list_of}: expected items that are not empty, received an empty one"
    assert refused.value.details() == expected


TENANT_BYTES = 8 * MEGABYTE
BATCHES = 60  # at a time, which wait for their refusals
BATCH_ROUNDS = 10


def test_parsed_requests_and_answers_that_wait_count(tokens):
    """The tenant "slow" gets one batch of a thousand items of a few bytes after the other refused, which takes a while."""
    item = b"\x0a\x03\x0a\x01x"  # a request for the session "x"
    flags = [f"--tokens={tokens}", f"--max_tenant_bytes={TENANT_BYTES}", "--loops=1"]
    with running_server(flags=flags) as addresses:
        batch = addresses.channel.unary_unary(f"/{POLICY}/ActBatch")
        process = Process(addresses.process.pid)
        idle = process.memory()
        process.reset_peak()
        refused = set()
        for _ in range(BATCH_ROUNDS):
            waiting = [
                batch.future(
                    item * ITEMS_MOST,
                    metadata=[("authorization", "Bearer slow")],
                    timeout=4 * DEADLINE_SECONDS,
                )
                for _ in range(BATCHES)
            ]
            refused |= {call.code() for call in waiting}
        # Each batch occupies a megabyte, so that the tenant has place for seven at a time.
        assert refused == {grpc.StatusCode.OK, grpc.StatusCode.RESOURCE_EXHAUSTED}
        assert process.peak() - idle < 3 * TENANT_BYTES
        with service_with(addresses, "rival") as rival:
            session = rival.OpenSession(policy="cartpole").session_id
            rival.Act(session_id=session, step=0, observation=OBSERVATION)


def test_a_batch_is_bounded_and_so_is_its_answer(addresses):
    with service_with(addresses, "agent") as agent:
        unknown = {"session_id": "0" * 32, "step": 1, "observation": OBSERVATION}
        with fails_with(grpc.StatusCode.INVALID_ARGUMENT, whole="requests: expected at most 1024, received 1025"):
            agent.ActBatch(requests=[unknown] * (ITEMS_MOST + 1))

        request = message_class(addresses.channel, "spikeserve.v1.ActBatchRequest")(
            requests=[unknown] * ITEMS_MOST
        )
        answer = agent.ActBatch(requests=[unknown] * ITEMS_MOST)
        assert len(answer.results) == ITEMS_MOST
        assert answer.ByteSize() <= 4 * request.ByteSize()


def test_a_batch_is_decided_in_the_order_of_its_requests(addresses):
    with service_with(addresses, "agent") as agent:
        sessions = [agent.OpenSession(policy="cartpole", seed=s).session_id for s in range(3)]
        items = [
            {"session_id": session, "step": step, "observation": OBSERVATION, "reward": 1.0}
            for step in range(30)
            for session in sessions
        ]
        results = agent.ActBatch(requests=items).results
        assert [result.code for result in results] == [0] * 90
        assert [result.response.step for result in results] == [i["step"] for i in items]
        assert [result.response.session_id for result in results] == sessions * 30


def start_batch(agent, channel):
    """Opens a session and sends it the largest batch. Returns its id and the future of the answer."""
    session = agent.OpenSession(policy="cartpole").session_id
    request_class = message_class(channel, "spikeserve.v1.ActBatchRequest")
    call = channel.unary_unary(f"/{POLICY}/ActBatch", request_serializer=request_class.SerializeToString)
    items = [{"session_id": session, "step": i, "observation": OBSERVATION} for i in range(ITEMS_MOST)]
    metadata = [("authorization", "Bearer agent")]
    return session, call.future(request_class(requests=items), metadata=metadata, timeout=DEADLINE_SECONDS)


def test_other_calls_are_answered_while_a_batch_is_decided(addresses):
    with (
        service_with(addresses, "agent") as agent,
        service_with(addresses, "rival") as rival,
    ):
        neighbour = rival.OpenSession(policy="cartpole").session_id
        step = 0
        answered = []
        for _ in range(5):  # the machine may stop one of the programs for a while
            _, batch = start_batch(agent, addresses.channel)
            first = step
            while not batch.done():
                rival.Act(session_id=neighbour, step=step, observation=OBSERVATION)
                step += 1
            assert batch.code() == grpc.StatusCode.OK
            answered.append(step - first)
        # Without a pause between the groups of a batch, one call waits for all of it.
        assert max(answered) > 5, answered


def test_a_cancelled_batch_is_decided_no_further(addresses):
    with service_with(addresses, "agent") as agent:
        decided = []
        for _ in range(5):  # as above
            session, batch = start_batch(agent, addresses.channel)
            while agent.GetSession(session_id=session).decisions == 0 and not batch.done():
                pass
            batch.cancel()
            counts = [-1]
            while counts[-1] != (now := agent.GetSession(session_id=session).decisions):
                counts.append(now)
            decided.append(counts[-1])
        assert min(decided) < ITEMS_MOST, decided
