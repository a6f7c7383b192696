"""Sequences of the Open Inference Protocol at servers that share a store."""

import grpc
import pytest
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import code_of
from serving import DEADLINE_SECONDS, method_of
from stored_sessions import Restartable, observation

pytestmark = WITHOUT_REDIS

SEED = 5
STEPS = 6


@pytest.fixture(scope="module")
def redis():
    with stopping([Redis(password="")]) as [started]:
        yield started


class Agent:
    """Plays the sequences of one id at a server."""

    def __init__(self, server):
        service = "inference.GRPCInferenceService"
        self._request_class, self._call = method_of(server.channel, service, "ModelInfer")
        _, self._stream = method_of(server.channel, service, "ModelStreamInfer")

    def request(self, t, token, start):
        request = self._request_class(model_name="cartpole", model_version="2")
        request.parameters["sequence_id"].int64_param = 7
        if start:
            request.parameters["sequence_start"].bool_param = True
            request.parameters["seed"].int64_param = SEED
        if token:
            request.parameters["sequence_token"].string_param = token
        for name, values in (("observation", observation(0, t)), ("reward", [0.1 * t])):
            tensor = request.inputs.add(name=name, datatype="FP32", shape=[len(values)])
            tensor.contents.fp32_contents.extend(values)
        return request

    def infer(self, t, token="", start=False):
        """Returns what was decided, and the token of the answer."""
        answer = self._call(self.request(t, token, start), timeout=DEADLINE_SECONDS)
        return [output.SerializeToString() for output in answer.outputs], answer.parameters["sequence_token"].string_param

    def infer_by_stream(self, t, token=""):
        """Returns the error of an answer on a stream; empty: none."""
        [answer] = self._stream(iter([self.request(t, token, False)]), timeout=DEADLINE_SECONDS)
        return answer.error_message


def play(agent, first=0, last=STEPS, token=""):
    """Returns what a sequence decides, and its token."""
    answers = []
    for t in range(first, last):
        answer, received = agent.infer(t, token, start=t == 0)
        token = received or token
        answers.append(answer)
    return answers, token


@pytest.fixture(scope="module")
def undisturbed():
    with Restartable("memory") as server:
        answers, token = play(Agent(server))
        assert token == ""
        return answers


@pytest.mark.parametrize("restarted_at", ["another server", "the same server"])
def test_an_older_sequence_of_the_same_id_answers_nothing(redis, undisturbed, restarted_at):
    store = f"redis://127.0.0.1:{redis.port}"
    with Restartable(store) as first, Restartable(store) as second:
        agents = [Agent(first), Agent(second)]
        _, old = play(agents[0], last=STEPS // 2)
        newer = agents[1] if restarted_at == "another server" else agents[0]
        answers, token = play(newer, last=STEPS // 2)
        for agent in agents:
            # The sequence has a token, and this request has none.
            expected = grpc.StatusCode.FAILED_PRECONDITION
            if agent is agents[1] and newer is not agent:
                expected = grpc.StatusCode.NOT_FOUND
            assert code_of(agent.infer, STEPS // 2) == expected
            if agent is not newer:
                assert code_of(agent.infer, STEPS // 2, token) == grpc.StatusCode.NOT_FOUND
                assert agent.infer_by_stream(STEPS // 2, token) != ""
            elif newer is agents[0]:
                assert code_of(agent.infer, STEPS // 2, old) == grpc.StatusCode.NOT_FOUND
        more, _ = play(newer, STEPS // 2, STEPS, token)
        assert answers + more == undisturbed


def test_a_flag_leaves_the_token_out(redis, undisturbed):
    with Restartable(f"redis://127.0.0.1:{redis.port}", ["--allow_unconfirmed_sequences"]) as server:
        assert play(Agent(server)) == (undisturbed, "")
