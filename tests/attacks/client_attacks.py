"""Attacks on an operator's terminal: servers that lie to spikectl, and agents whose names a terminal would obey."""

import contextlib
import itertools
import time

import grpc
from contract import message_class, v1
from hostile_answers import COMMANDS, ESCAPES, RandomAnswers, check_shown, serving, spikectl

from tests.attacks.flood import Sent
from tests.attacks.tenant_attacks import calling, in_threads

INFER = "/inference.GRPCInferenceService/ModelInfer"
AGENTS = 4


def answers_of_a_lying_server(_, seconds):
    """Answers each command of spikectl with numbers that are no indices, names of escapes, and pages without end."""
    sent, answers = Sent(), RandomAnswers()
    end = time.monotonic() + seconds
    with serving(answers) as address:
        for seed, command in enumerate(itertools.cycle(COMMANDS)):
            if time.monotonic() > end:
                return sent
            answers.begin(seed)
            sent.connections += 1
            done = spikectl(address, *command)
            assert done.returncode in (0, 1), done
            check_shown(done.stdout + done.stderr)


def names_that_a_terminal_obeys(address, seconds):
    """Opens sessions whose ids and labels have escapes. An operator lists the sessions and the history in the end."""
    with calling(address) as agents:

        def infer(is_over):
            tensor = {"name": "observation", "datatype": "FP32", "shape": [4], "contents": {"fp32_contents": [0.0] * 4}}
            start = {"sequence_start": {"bool_param": True}}
            while not is_over():
                with contextlib.suppress(grpc.RpcError):
                    parameters = start | {"sequence_id": {"string_param": f"{time.monotonic_ns()}{ESCAPES}"}}
                    request = message_class("inference.ModelInferRequest")
                    agents(INFER, request(model_name="cartpole", inputs=[tensor], parameters=parameters))
                with contextlib.suppress(grpc.RpcError):
                    agents.open(labels={"robot": ESCAPES})
                with contextlib.suppress(grpc.RpcError):
                    agents("/spikeserve.v1.PolicyService/ExportSession", v1("ExportSessionRequest", session_id=ESCAPES))

        in_threads(AGENTS, seconds, infer)
    for action in ("sessions", "history"):
        done = spikectl(f"{address[0]}:{address[1]}", "admin", action, token="machine")
        assert done.returncode == 0, done
        check_shown(done.stdout)
    return agents.sent
