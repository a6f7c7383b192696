"""A robot that plays a session beat by beat, with requests of its own."""

import contextlib

import grpc
import pytest
from security import POLICY
from serving import DEADLINE_SECONDS, method_of

SESSION = "0" * 31 + "a"
KINDS = {
    "greedy": {"policy": "pendulum"},
    "sampled": {"policy": "cartpole", "action_selection": "SAMPLE", "temperature": 0.7, "seed": 3},
    "small": {"policy": "cartpole-small"},
    "learning": {
        "policy": "cartpole",
        "action_selection": "SAMPLE",
        "learning": {"modulator": "target", "learning_rate": 0.05},
    },
}


def observation(size, step):
    return [0.05 * ((step * (k + 3)) % 7 - 3) for k in range(size)]


def as_fields(action):
    """Returns an action as keyword arguments, for the messages of any connection."""
    if isinstance(action, dict):
        return action
    if action.WhichOneof("kind") == "discrete":
        return {"discrete": action.discrete}
    return {"continuous": {"values": list(action.continuous.values)}}


class Robot:
    """Plays one session, and remembers its beats."""

    def __init__(self, service, **opening):
        opening = {"session_id": SESSION} | opening
        with contextlib.suppress(grpc.RpcError):
            service.CloseSession(session_id=opening["session_id"])
        self.service = service
        self.opened = service.OpenSession(**opening)
        self.id = self.opened.session_id
        self.beats = []

    def beat(self, step, executed=None):
        fields = {
            "step": step,
            "observation": observation(self.opened.observation_size, step),
            "reward": 0.1 * (step % 7),
        }
        return fields if executed is None else fields | {"executed": executed}

    def request(self, history=0, **fields):
        """Returns the request for the next step, with the last `history` beats."""
        step = len(self.beats)
        return {
            "session_id": self.id,
            "decision": step,
            "history": self.beats[step - history :],
            **self.beat(step),
            **fields,
        }

    def act(self, history=0, executed=None, **fields):
        """Asks for the next step and executes the answer, or `executed`."""
        answer = self.service.Act(**self.request(history, **fields))
        self.execute(answer.action if executed is None else executed)
        return answer

    def execute(self, action):
        self.beats.append(self.beat(len(self.beats), as_fields(action)))

    def value(self):
        return self.service.ExportSession(session_id=self.id).value

    def is_refused(self, request, message):
        """Sends a request, and checks that it is invalid by `message`, which is a pattern, and changes nothing."""
        before = self.value()
        with pytest.raises(grpc.RpcError, match=message) as error:
            self.service.Act(**request)
        assert error.value.code() == grpc.StatusCode.INVALID_ARGUMENT
        assert self.value() == before


def answers_on_stream(channel, requests):
    """Sends requests, which are dicts of fields, on one ActStream. Returns their answers."""
    request, stream = method_of(channel, POLICY, "ActStream")
    return list(stream(iter([request(**fields) for fields in requests]), timeout=DEADLINE_SECONDS))
