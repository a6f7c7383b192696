"""The unmodified client sonora of gRPC-Web, on the HTTP port."""

import grpc
import pytest
import sonora.client
from contract import call, v1
from security import OBSERVATION, POLICY
from serving import DEADLINE_SECONDS

STEPS = 20


@pytest.fixture
def channels(server):
    """Yields a channel of gRPC and one of gRPC-Web."""
    web = sonora.client.insecure_web_channel(f"http://{server.http}")
    with grpc.insecure_channel(server.grpc) as native, web:
        yield native, web


def decisions(channel):
    """Returns the answers of an episode whose observations grow."""
    opened = call(channel, f"/{POLICY}/OpenSession")(
        v1("OpenSessionRequest", policy="cartpole"), timeout=DEADLINE_SECONDS
    )
    act = call(channel, f"/{POLICY}/Act")
    answers = []
    for step in range(STEPS):
        observation = [value * step for value in OBSERVATION]
        request = v1(
            "ActRequest",
            session_id=opened.session_id,
            observation=observation,
            step=step,
        )
        answer = act(request, timeout=DEADLINE_SECONDS)
        answers.append(
            (
                answer.action.discrete,
                list(answer.action_probabilities),
                answer.stats.spikes,
            )
        )
    return answers


def test_answers_are_those_of_grpc(channels):
    native, web = channels
    assert decisions(web) == decisions(native)


def test_errors_are_those_of_grpc(channels):
    errors = []
    for channel in channels:
        with pytest.raises(grpc.RpcError) as error:
            call(channel, f"/{POLICY}/Act")(
                v1("ActRequest", session_id="unknown"), timeout=DEADLINE_SECONDS
            )
        errors.append((error.value.code(), error.value.details()))
    assert errors[0] == errors[1]
    assert errors[0][0] == grpc.StatusCode.NOT_FOUND
