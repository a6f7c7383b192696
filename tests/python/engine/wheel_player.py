"""Plays all shipped policies with the engine of this process and with a server, and prints what both decided.

usage: wheel_player.py POLICIES ADDRESS
"""

import json
import pathlib
import random
import sys

import numpy as np
import spikeserve
import spikeserve_engine

STEPS = 25  # more than a context of 20
SETTINGS = {"learning": spikeserve.Learning(rule="hebbian", modulator="target")}


def play(session, observation_size):
    """Returns the exact bytes of each decision. A learning session has another head after each step."""
    numbers = random.Random(3)  # gives the same numbers in every version of Python
    decisions = []
    for _ in range(STEPS):
        observation = [numbers.uniform(-1, 1) for _ in range(observation_size)]
        decision = session.act(observation, numbers.uniform(-1, 1))
        probabilities = decision.action_probabilities
        decisions.append((
            np.asarray(decision.action).tobytes().hex(),
            None if probabilities is None else probabilities.tobytes().hex(),
            decision.return_to_go.hex(),
            decision.stats.spikes,
        ))
    return decisions


def main(policies, address):
    engine_decisions, server_decisions = {}, {}
    with spikeserve.Client(address) as client:
        for path in sorted(pathlib.Path(policies).glob("*/*/policy.safetensors")):
            policy, version = path.parts[-3:-1]
            engine = spikeserve_engine.Engine(path)
            engine_decisions[f"{policy}/{version}"] = play(engine.session(**SETTINGS), engine.observation_size)
            options = spikeserve.SessionOptions(version=int(version), **SETTINGS)
            with client.open_session(policy, options) as session:
                server_decisions[f"{policy}/{version}"] = play(session, engine.observation_size)
    modules = [spikeserve.__file__, spikeserve_engine.__file__]
    version = "{}.{}".format(*sys.version_info)
    print(json.dumps({"engine": engine_decisions, "server": server_decisions, "modules": modules, "version": version}))


if __name__ == "__main__":
    main(*sys.argv[1:])
