"""The pilot of the C++ client in a process of its own, with the methods of the Python one."""

import json
import math
import os
import subprocess
import threading
from types import SimpleNamespace

import grpc
import numpy as np
import spikeserve
from spikeserve.errors import make_error


def number(value):
    """Returns a number for JSON; null stands for NaN."""
    try:
        return float(value) if math.isfinite(float(value)) else None
    except (TypeError, ValueError):
        return None


class CppPilot:
    """Starts client_pilot, whose lines are described there, with a `prefix` of its command."""

    def __init__(self, client, policy, period, session=spikeserve.SessionOptions(), local=None, prefix=(), **options):
        opening = session.to_wire(policy)
        if "local_policy" in options:
            options["local"] = str(options.pop("local_policy"))
        elif local is not False:
            options["local"] = ""
        servers = client if isinstance(client, str) else ",".join(r.address for r in client.replicas)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen([*prefix, os.environ["CLIENT_PILOT_PROGRAM"]], **pipes)
        self.allocations = []  # of each beat, on its thread
        self._lock = threading.Lock()  # of a line and its answer
        self._ended = 0
        opening = opening.SerializeToString().hex()
        self._ask(servers=servers, opening=opening, period=period, **options)

    def _ask(self, **line):
        with self._lock:
            print(json.dumps(line), file=self.process.stdin, flush=True)
            answer = json.loads(self.process.stdout.readline())
        if isinstance(answer, dict) and "error" in answer:
            raise make_error("Pilot", code_of(answer["code"]), answer["error"])
        return answer

    @property
    def session_id(self):
        return self._ask(do="session")

    def beat(self, observation, reward=0.0, *, executed_action=None):
        line = {"observation": [number(x) for x in observation], "reward": number(reward)}
        if isinstance(executed_action, spikeserve.Executed):
            line |= {"source": executed_action.kind, "operator_id": executed_action.operator_id}
            executed_action = executed_action.action
        if executed_action is not None:
            line["executed"] = [number(x) for x in executed_action]
        action = self._ask(do="beat", **line)
        if "invalid" in action:
            raise ValueError(action["invalid"])
        self.allocations.append(action.pop("allocations"))
        if isinstance(action["action"], list):
            action["action"] = np.float32(action["action"])
        return SimpleNamespace(**action)

    def end_episode(self, reward, terminated=False):
        self._ask(do="end", reward=number(reward), terminated=terminated)
        self._ended += 1
        return CppSummary(self._ask, self._ended - 1)

    def stats(self):
        return SimpleNamespace(**self._ask(do="stats"))

    def wait_ready(self, timeout):
        return self._ask(do="wait", timeout=timeout)

    def suspend(self, seconds):
        """Lets the clock that counts the sleep of a computer jump."""
        self._ask(do="suspend", seconds=seconds)

    def value(self):
        """Returns the value of the session on the robot's engine."""
        return bytes.fromhex(self._ask(do="value"))

    def close(self):
        self._ask(do="close")

    def end(self):
        """Ends the program. Returns what the pilot has logged."""
        self.process.stdin.close()
        log = self.process.stderr.read()
        self.process.stdout.close()
        self.process.stderr.close()
        assert self.process.wait() == 0
        return log


class CppSummary:
    """The future of an episode's summary."""

    def __init__(self, ask, episode):
        self._ask, self._episode = ask, episode
        self._known = None

    def result(self, timeout):
        self._known = self._known or self._ask(do="summary", episode=self._episode, timeout=timeout)
        if not self._known:
            raise TimeoutError
        return SimpleNamespace(**self._known)

    def done(self):
        try:
            self.result(0)
        except TimeoutError:
            return False
        return True


def code_of(number):
    """Returns the status code of gRPC with a number."""
    return next(code for code in grpc.StatusCode if code.value[0] == number)
