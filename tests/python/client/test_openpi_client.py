"""The unmodified openpi-client plays CartPole, in a Python of its own, because it needs NumPy 1."""

import json

import pytest
from gateways import running_gateway
from own_environment import python_with, run_in
from serving import running_server

PLAY = """
import json, sys
import gymnasium
import numpy as np
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.websocket_client_policy import WebsocketClientPolicy

policy = WebsocketClientPolicy(sys.argv[1])
broker = ActionChunkBroker(policy, action_horizon=1)
environment = gymnasium.make("CartPole-v1")
returns = []
for seed in (1_000_000, 1_000_001):
    observation, _ = environment.reset(seed=seed)
    broker.reset()
    message, total, over = {"observation": observation, "reset": True}, 0.0, False
    while not over:
        answer = broker.infer(message)
        observation, reward, terminated, truncated, _ = environment.step(int(answer["actions"][0]))
        message = {"observation": observation, "reward": reward}
        total += reward
        over = terminated or truncated
    returns.append(total)
try:
    policy.infer({"observation": np.zeros(3)})
    error = ""
except RuntimeError as raised:
    error = str(raised)
metadata = policy.get_server_metadata()
print(json.dumps({"returns": returns, "error": error, "policy": metadata["policy"], "numpy": np.__version__}))
"""


@pytest.fixture(scope="module")
def python():
    return python_with("openpi-client==0.1.2", "gymnasium==1.4.0")


def test_openpi_client_plays_cartpole(python):
    with running_server() as server, running_gateway(server.grpc, "--policy=cartpole") as address:
        played = json.loads(run_in(python, PLAY, address))
    assert played["returns"] == [500, 500]
    assert played["policy"] == "cartpole"
    assert "Error in inference server:\nobservation: expected 4 numbers" in played["error"]
    assert played["numpy"].startswith("1.")
