"""Code that protoc generates from the wire contract is importable beside the package, in either order."""

import os
import pathlib
import subprocess
import sys

import pytest
from serving import run, running_server

PROTO = pathlib.Path(__file__).parents[3] / "proto"
CONTRACT = ("spikeserve/v1/policy_service.proto", "spikeserve/v1/policy_admin.proto")

CALL = """
import sys
import grpc
from spikeserve.v1 import policy_service_pb2, policy_service_pb2_grpc

with grpc.insecure_channel(sys.argv[1]) as channel:
    stub = policy_service_pb2_grpc.PolicyServiceStub(channel)
    opened = stub.OpenSession(policy_service_pb2.OpenSessionRequest(policy="cartpole"))
    request = policy_service_pb2.ActRequest(session_id=opened.session_id, observation=[0.01, -0.02, 0.03, 0.1])
    by_stub = list(stub.Act(request).action_probabilities)
import spikeserve
with spikeserve.Client(sys.argv[1]) as client, client.open_session("cartpole") as session:
    assert list(session.act([0.01, -0.02, 0.03, 0.1]).action_probabilities) == by_stub
print("equal")
"""


@pytest.fixture(scope="module")
def stubs(tmp_path_factory):
    """Generates the stubs. Returns their folder."""
    folder = tmp_path_factory.mktemp("stubs")
    protoc = [sys.executable, "-m", "grpc_tools.protoc", f"--proto_path={PROTO}"]
    subprocess.run([*protoc, f"--python_out={folder}", f"--grpc_python_out={folder}", *CONTRACT], check=True)
    return folder


@pytest.mark.parametrize("first", ["stubs", "package"])
def test_stubs_are_importable_beside_the_package(first, stubs):
    """Whichever stands first on the path, and whichever is imported first."""
    package = os.environ["PYTHONPATH"]
    path = [str(stubs), package] if first == "stubs" else [package, str(stubs)]
    script = CALL if first == "stubs" else f"import spikeserve\n{CALL}"
    with running_server() as server:
        done = run(sys.executable, "-c", script, server.grpc, env=os.environ | {"PYTHONPATH": os.pathsep.join(path)})
    assert done.stdout == "equal\n"
