"""Every call has a cost: where it is answered, and which rate of the tenant counts it."""

import contextlib
import json
import os
import pathlib

import grpc
import pytest
from gymnasium import make
from random_policy import export_random
from security import ADMIN, OBSERVATION, POLICY, TOKENS, Bearer, entry, service_with, until
from serving import Service, running_server

INFERENCE = "inference.GRPCInferenceService"
VERSIONS = 1000
ON_THE_LOOP = {"decision", "light"}

# By service: the class of each method, and a request that it accepts or refuses for its content. "SESSION" stands for
# the id of an open session. A method that is missing here fails the test.
METHODS = {
    POLICY: {
        "ListPolicies": ("listing", {}),
        "OpenSession": ("light", {"policy": "small"}),
        "Act": ("decision", {"session_id": "SESSION", "observation": OBSERVATION}),
        "ActBatch": (
            "decision",
            {"requests": [{"session_id": "SESSION", "observation": OBSERVATION}]},
        ),
        "ActStream": ("decision", None),
        "EndEpisode": ("light", {"session_id": "SESSION"}),
        "GetSession": ("light", {"session_id": "SESSION"}),
        "Explain": ("explain", {"session_id": "SESSION"}),
        "ExportSession": ("operator", {"session_id": "SESSION"}),
        "CloseSession": ("light", {"session_id": "0" * 32}),
    },
    ADMIN: {
        "LoadPolicy": ("operator", {"policy": "none", "version": 1}),
        "UnloadPolicy": ("operator", {"policy": "none", "version": 1}),
        "ReloadPolicies": ("operator", {}),
        "PushPolicy": ("operator", None),
        "PullPolicy": ("operator", {}),
        "RemovePolicy": ("operator", {}),
        "SetDefaultVersion": ("operator", {}),
        "SetLabel": ("operator", {}),
        "RemoveLabel": ("operator", {}),
        "SetTraffic": ("operator", {}),
        "SetTrafficShares": ("operator", {}),
        "SetShadow": ("operator", {}),
        "GetUsage": ("listing", {}),
        "ListHistory": ("listing", {}),
        "StartRollout": ("operator", {}),
        "AbortRollout": ("operator", {}),
        "ListRollouts": ("listing", {}),
        "ListSessions": ("listing", {}),
        "GetHead": ("listing", {}),
        "PromoteHead": ("operator", {}),
        "RollbackHead": ("operator", {}),
        "PauseLearning": ("operator", {}),
        "ResumeLearning": ("operator", {}),
        "HoldSessions": ("operator", {}),
        "ResumeSessions": ("operator", {}),
        "ListHolds": ("listing", {}),
        "TakeControl": ("operator", {}),
        "SteerSession": ("light", {"session_id": "SESSION"}),
        "ReturnControl": ("operator", {"session_id": "SESSION"}),
        "Drain": ("operator", {}),  # the last: it refuses new sessions
    },
    INFERENCE: {
        "ServerLive": ("light", {}),
        "ServerReady": ("light", {}),
        "ModelReady": ("light", {"name": "small"}),
        "ServerMetadata": ("light", {}),
        "ModelMetadata": ("listing", {"name": "small"}),
        "ModelInfer": ("decision", {"model_name": "small"}),
        "ModelStreamInfer": ("decision", None),
        "ModelConfig": ("light", {"name": "small"}),
        "ModelStatistics": ("listing", {}),
        "RepositoryIndex": ("listing", {}),
        "RepositoryModelLoad": ("operator", {"model_name": "none"}),
        "RepositoryModelUnload": ("operator", {"model_name": "none"}),
    },
}
UNARY = [
    (service, name)
    for service in (POLICY, INFERENCE, ADMIN)
    for name, (_, request) in METHODS[service].items()
    if request is not None
]


def tenants():
    """Returns a tokens file with a tenant for each method, of one call in 100 s, whose token is its name."""
    rate = 0.01
    slow = {
        "decisions_per_second": rate,
        "calls_per_second": {c: rate for c in ("light", "listing", "explain", "operator")},
    }
    names = [name for _, name in UNARY]
    return {
        "tenants": TOKENS["tenants"] | dict.fromkeys(names, slow),
        "tokens": TOKENS["tokens"] + [entry(name, "operator", name) for name in names],
    }


@pytest.fixture(scope="module")
def servers(tmp_path_factory):
    """Starts servers with one version of a policy and with many, and yields both."""
    folder = tmp_path_factory.mktemp("policies")
    export_random(folder / "one", "small", make("CartPole-v1"))
    file = folder / "one" / "small" / "1" / "policy.safetensors"
    for version in range(1, VERSIONS + 1):
        copy = folder / "many" / "small" / str(version) / file.name
        copy.parent.mkdir(parents=True)
        os.link(file, copy)
    tokens = folder / "tokens.json"
    tokens.write_text(json.dumps(tenants()))
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(running_server(folder / which, flags=[f"--tokens={tokens}"]))
            for which in ("one", "many")
        ]


def times_run(pid, name):
    """Returns how often the threads of a name have run so far."""
    total = 0
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        if (task / "comm").read_text().strip() == name:
            total += int((task / "schedstat").read_text().split()[2])
    return total


def wait_for_threads(pid):
    """Waits until loops and workers sleep: one that has answered may still be on its way to that."""

    def asleep():
        for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
            name, _, rest = (task / "stat").read_text().partition("(")[2].rpartition(")")
            if name in ("loop", "worker") and rest.split()[0] != "S":
                return False
        return True

    until(asleep)


def with_session(value, session):
    """Returns a request with the id of a session in place of "SESSION"."""
    return json.loads(json.dumps(value).replace("SESSION", session))


def called(service, name, request):
    """Makes a call. Returns its code and the bytes of its answer."""
    try:
        return grpc.StatusCode.OK, getattr(service, name)(**request).ByteSize()
    except grpc.RpcError as error:
        return error.code(), 0


@pytest.mark.parametrize("service", METHODS)
def test_the_table_has_every_method(servers, service):
    described = Service(servers[0].channel, service)
    expected = {name for name, (_, request) in METHODS[service].items() if request is not None}
    assert {name for name in vars(described) if name[0].isupper()} == expected


def test_what_grows_with_the_versions_is_answered_off_the_loops(servers):
    answers = []
    for addresses in servers:
        pid = addresses.process.pid
        with contextlib.ExitStack() as stack:
            services = {
                service: stack.enter_context(service_with(addresses, "machine", service))
                for service in METHODS
            }
            sizes = {}
            for service, name in UNARY:
                cost, request = METHODS[service][name]
                if name != "Drain":
                    session = services[POLICY].OpenSession(policy="small").session_id
                wait_for_threads(pid)
                before = times_run(pid, "worker")
                code, sizes[name] = called(services[service], name, with_session(request, session))
                print(name, cost, code, sizes[name])
                ran = times_run(pid, "worker") > before
                assert ran == (cost not in ON_THE_LOOP), f"{name} of class {cost}"
            answers.append(sizes)
    one, many = answers
    for service, name in UNARY:
        if METHODS[service][name][0] in ON_THE_LOOP:
            assert abs(many[name] - one[name]) <= 16, f"{name}: the answer grows"
    assert many["ListPolicies"] > VERSIONS / 2 * one["ListPolicies"]


# ModelInfer counts when it decides, as ActStream and ModelStreamInfer do.
RATED = [(service, name) for service, name in UNARY if name != "ModelInfer"]


@pytest.mark.parametrize(("service", "name"), RATED)
def test_every_call_has_a_rate(servers, service, name):
    cost, request = METHODS[service][name]
    limited = Service(servers[0].channel, service, grpc.intercept_channel(servers[0].channel, Bearer(name)))
    codes = []
    for _ in range(3):
        try:
            answer = getattr(limited, name)(**with_session(request, "0" * 32))
            codes += [result.code for result in getattr(answer, "results", [])]
        except grpc.RpcError as error:
            codes.append(error.code().value[0])
            last = error
    exhausted = grpc.StatusCode.RESOURCE_EXHAUSTED.value[0]
    assert codes[-2:] == [exhausted] * 2
    if cost != "decision":
        assert last.details().startswith(f"calls_per_second.{cost}: ")


def test_an_empty_batch_counts(servers):
    token = Bearer("ActBatch")
    batch = Service(servers[0].channel, POLICY, grpc.intercept_channel(servers[0].channel, token)).ActBatch
    with pytest.raises(grpc.RpcError, match="decisions_per_second"):
        for _ in range(3):
            batch(requests=[])
