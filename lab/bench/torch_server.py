"""A gRPC server in Python for the PyTorch model, with the messages of spikeserve: the usual way to serve it.

usage: torch_server.py POLICY_FILE STUBS   (STUBS: the folder of the code that protoc generated from the proto)

It stores the window of each session and recomputes it at every decision. Prints "listening on HOST:PORT".
"""

import collections
import concurrent.futures
import itertools
import sys

import grpc
import torch
import torch_policy


class Session:
    def __init__(self, policy):
        self.policy = policy
        self.reset()

    def reset(self):
        context = self.policy.config["context"]
        self.step = 0
        self.return_to_go = self.policy.target_return
        self.returns = collections.deque(maxlen=context)
        self.observations = collections.deque(maxlen=context)
        self.actions = collections.deque(maxlen=context - 1)

    def act(self, observation, reward):
        if self.step > 0:
            self.return_to_go -= reward
        self.returns.append(self.return_to_go)
        self.observations.append(observation)
        action, probabilities = self.policy.decide(
            self.step + 1 - len(self.returns), list(self.returns), list(self.observations), list(self.actions)
        )
        self.actions.append(action)
        self.step += 1
        return action, probabilities


def make_service(policy, messages, base):
    class Service(base):
        def __init__(self):
            self.sessions = {}
            self.ids = itertools.count()

        def ListPolicies(self, request, context):
            return messages.ListPoliciesResponse(policies=[messages.PolicyInfo(name="torch")])

        def OpenSession(self, request, context):
            session_id = f"{next(self.ids):032d}"
            self.sessions[session_id] = Session(policy)
            size = policy.p["observation.mean"].numel()
            return messages.OpenSessionResponse(session_id=session_id, observation_size=size)

        def Act(self, request, context):
            session = self.sessions[request.session_id]
            action, probabilities = session.act(list(request.observation), request.reward)
            return messages.ActResponse(
                session_id=request.session_id,
                step=request.step,
                action=messages.Action(discrete=action),
                action_probabilities=probabilities,
                return_to_go=session.return_to_go,
            )

        def EndEpisode(self, request, context):
            self.sessions[request.session_id].reset()
            return messages.EndEpisodeResponse()

        def CloseSession(self, request, context):
            del self.sessions[request.session_id]
            return messages.CloseSessionResponse()

    return Service()


def main():
    policy_file, stubs = sys.argv[1:]
    sys.path.insert(0, stubs)
    from spikeserve.v1 import policy_service_pb2, policy_service_pb2_grpc

    torch.set_num_threads(1)
    service = make_service(
        torch_policy.TorchPolicy(policy_file), policy_service_pb2, policy_service_pb2_grpc.PolicyServiceServicer
    )
    server = grpc.server(concurrent.futures.ThreadPoolExecutor(max_workers=4))
    policy_service_pb2_grpc.add_PolicyServiceServicer_to_server(service, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    print(f"listening on 127.0.0.1:{port}", flush=True)
    server.wait_for_termination()


if __name__ == "__main__":
    main()
