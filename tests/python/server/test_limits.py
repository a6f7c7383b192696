"""Limits of a tenant: the server rejects its excess calls and serves other tenants as before."""

import json

import grpc
from security import OBSERVATION, POLICY, code_of, entry, fails_with, service_with
from serving import DEADLINE_SECONDS, message_class, method_of, running_server


def retry_delay(addresses, error):
    """Returns the seconds of google.rpc.RetryInfo in the details of a rejected call."""
    trailers = {entry.key: entry.value for entry in error.trailing_metadata()}
    status = message_class(addresses.channel, "google.rpc.Status")
    info = message_class(addresses.channel, "google.rpc.RetryInfo")()
    (detail,) = status.FromString(trailers["grpc-status-details-bin"]).details
    assert detail.Unpack(info), detail
    return info.retry_delay.seconds + info.retry_delay.nanos * 1e-9


def test_a_flood_and_too_many_sessions_are_resource_exhausted(addresses):
    with service_with(addresses, "small") as small, service_with(addresses, "agent") as other:
        sessions = [small.OpenSession(policy="cartpole").session_id for _ in range(2)]
        with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED) as too_many:
            small.OpenSession(policy="cartpole")
        assert retry_delay(addresses, too_many.value) > 0
        small.CloseSession(session_id=sessions.pop())
        sessions.append(small.OpenSession(policy="cartpole").session_id)

        neighbour = other.OpenSession(policy="cartpole").session_id
        refused = None
        for step in range(1000):
            other.Act(session_id=neighbour, step=step, observation=OBSERVATION)
            try:  # repeats one step: every repetition counts as a call
                small.Act(session_id=sessions[0], step=0, observation=OBSERVATION)
            except grpc.RpcError as error:
                refused = error
                break
        assert refused.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert 0 < retry_delay(addresses, refused) <= 0.2
        other.Act(session_id=neighbour, step=step + 1, observation=OBSERVATION)


def test_a_stream_goes_on_after_a_refusal(addresses):
    with service_with(addresses, "slow") as slow:
        session = slow.OpenSession(policy="cartpole").session_id
        request_class, call = method_of(addresses.channel, POLICY, "ActStream")
        requests = [request_class(session_id=session, observation=OBSERVATION)] * 12
        stream = call(iter(requests), metadata=[("authorization", "Bearer slow")], timeout=DEADLINE_SECONDS)
        answers = list(stream)
    assert stream.code() == grpc.StatusCode.OK
    assert len(answers) == 12
    refusals = [answer.error for answer in answers if answer.HasField("error")]
    # The limit allows 5 requests at once, then one every 0.2 s. A rejection takes 0.1 s, so the server rejects at most
    # 2 of 3 requests. Without that delay it would reject all 7 requests after the first 5.
    assert 0 < len(refusals) <= 6
    for error in refusals:
        assert error.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]
        assert 0 < error.retry_after_seconds <= 0.2


def test_a_batch_over_the_limit_waits_for_its_answer(addresses):
    with service_with(addresses, "slow") as slow:
        session = slow.OpenSession(policy="cartpole").session_id
        item = {"session_id": session, "step": 0, "observation": OBSERVATION}

        def is_refused():
            (result,) = slow.ActBatch(requests=[item]).results
            return result.code == grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]

        for _ in range(100):
            if is_refused():
                break
        # The limit allows one request every 0.2 s, and a rejection takes at least 0.05 s. Without that delay the
        # server would reject all ten requests.
        assert not all([is_refused() for _ in range(10)])


def test_a_batch_is_counted_and_decided_once(addresses, tmp_path):
    """Also if the store is asked for a session that one of its items has not found."""
    tokens = tmp_path / "tokens.json"
    tokens.write_text(json.dumps({"tenants": {"ten": {"decisions_per_second": 10}}, "tokens": [entry("ten", "agent", "ten")]}))
    with running_server(flags=[f"--tokens={tokens}", f"--session_store=file:{tmp_path}/store"]) as server:
        with service_with(server, "ten") as ten:
            session = ten.OpenSession(policy="cartpole", durability="SYNC").session_id
            steps = [{"session_id": session, "step": t, "observation": OBSERVATION, "reward": 1.0} for t in range(9)]
            results = ten.ActBatch(requests=[*steps[:4], steps[0] | {"session_id": "0" * 32}, *steps[4:]]).results
    codes = [result.code for result in results]
    assert codes == [0] * 4 + [grpc.StatusCode.NOT_FOUND.value[0]] + [0] * 5
    assert [result.response.step for result in results if not result.code] == list(range(9))
    assert [result.response.durable_decision for result in results if not result.code] == list(range(1, 10))


def test_an_oversized_message_is_resource_exhausted(addresses):
    with service_with(addresses, "small") as small, service_with(addresses, "agent") as other:
        labels = {"note": "x" * 220}
        exhausted = grpc.StatusCode.RESOURCE_EXHAUSTED
        assert code_of(small.OpenSession, policy="cartpole", labels=labels) == exhausted
        assert code_of(other.OpenSession, policy="cartpole", labels=labels) == grpc.StatusCode.OK
        # The limit of the server, --max_message_bytes.
        assert code_of(other.OpenSession, policy="x" * 5_000_000) == exhausted
