"""No answer holds a number that is not finite, whatever heads, policies and agents do."""

import math
import shutil

import grpc
import pytest
from made_policies import FAR, ZERO, add_overflowing
from security import OBSERVATION, code_of, fails_with, until
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, method_of, metric, running_server, status_of

INTERNAL = grpc.StatusCode.INTERNAL


def numbers(message):
    """Yields every number of a message."""
    for field, value in message.ListFields():
        for one in value if field.is_repeated else [value]:
            if field.message_type is not None:
                if not field.message_type.GetOptions().map_entry:
                    yield from numbers(one)
            elif isinstance(one, float):
                yield one


def assert_finite(message):
    assert all(math.isfinite(number) for number in numbers(message)), message


@pytest.mark.parametrize(("policy", "size"), [("cartpole", 2 * 128), ("pendulum", 128)])
@pytest.mark.parametrize("learning", [None, {"scope": "SESSION", "rule": "hebbian"}])
def test_a_head_that_overflows_is_refused_at_opening(service, policy, size, learning):
    def opened(value):
        return service.OpenSession(policy=policy, head_delta=[value] * size, learning=learning)

    for value in (1e38, -1e38, 1e31):
        with fails_with(grpc.StatusCode.INVALID_ARGUMENT) as refused:
            opened(value)
        assert refused.value.details().startswith("head_delta: expected a Frobenius norm of at most 1e+30")
    session = opened(1e27).session_id
    observation = OBSERVATION if policy == "cartpole" else OBSERVATION[:3]
    for step in range(3):
        assert_finite(service.Act(session_id=session, step=step, observation=observation, reward=1.0))
    assert_finite(service.GetSession(session_id=session, include_head_delta=True))


@pytest.mark.parametrize("modulator", ["realized", "target"])
def test_a_head_never_learns_to_overflow(service, modulator):
    learning = {
        "modulator": modulator,
        "learning_rate": 1e300,
        "clip": 3e38,
        "max_drift": 1e300,
        "discount": 1.0 if modulator == "realized" else None,
    }
    session = service.OpenSession(
        policy="cartpole", learning=learning, action_selection="SAMPLE", temperature=1e-37
    ).session_id
    for episode in range(3):
        for step in range(5):
            assert_finite(
                service.Act(
                    session_id=session, step=step, observation=FAR, reward=1e30 * (-1) ** (step + episode)
                )
            )
            assert_finite(service.GetSession(session_id=session, include_head_delta=True))
        assert_finite(service.EndEpisode(session_id=session, reward=1e30, terminated=True))


@pytest.fixture(scope="module")
def overflowing(tmp_path_factory):
    """Returns a policy directory whose `cartpole/2` fails to decide after FAR."""
    policies = tmp_path_factory.mktemp("policies")
    shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", policies / "cartpole" / "1")
    add_overflowing(policies, 2)
    return policies


def alerts(addresses):
    return {(alert["name"], alert["state"]) for alert in status_of(addresses)["alerts"]}


def infer(channel, observation):
    """Makes one decision of a new sequence by the Open Inference Protocol."""
    request_class, call = method_of(channel, "inference.GRPCInferenceService", "ModelInfer")
    request = request_class(model_name="cartpole", model_version="2")
    request.parameters["sequence_id"].int64_param = 7
    request.parameters["sequence_start"].bool_param = True
    tensor = request.inputs.add(name="observation", datatype="FP32", shape=[4])
    tensor.contents.fp32_contents.extend(observation)
    return call(request, timeout=DEADLINE_SECONDS)


def test_a_decision_that_is_not_finite_is_an_error_and_changes_nothing(overflowing):
    with running_server(overflowing) as addresses:
        session = addresses.agent.OpenSession(policy="cartpole", version=2).session_id
        healthy = addresses.agent.OpenSession(policy="cartpole", version=2).session_id
        before = addresses.agent.GetSession(session_id=session)
        for _ in range(2):
            with fails_with(INTERNAL, "cartpole version 2"):
                addresses.agent.Act(session_id=session, observation=FAR)
        assert addresses.agent.GetSession(session_id=session) == before
        # Another session of the same group is decided, as if it were alone.
        results = addresses.agent.ActBatch(
            requests=[
                {"session_id": session, "observation": FAR},
                {"session_id": healthy, "observation": ZERO},
            ]
        ).results
        assert results[0].code == INTERNAL.value[0]
        assert results[1].code == 0
        assert_finite(results[1].response)
        # The session continues, and decides as one that never failed.
        again = addresses.agent.Act(session_id=session, observation=ZERO)
        assert list(again.action_probabilities) == list(results[1].response.action_probabilities)
        assert list(again.stats.spikes_by_stage.ListFields()) == list(
            results[1].response.stats.spikes_by_stage.ListFields()
        )
        assert code_of(infer, addresses.channel, FAR) == INTERNAL
        assert metric(addresses, "spikeserve_non_finite_answers_total", policy="cartpole", version=2) == 4.0
        assert metric(addresses, "spikeserve_non_finite_answers_total") == 4.0
        until(lambda: ("SpikeserveNonFiniteAnswers", "firing") in alerts(addresses))
