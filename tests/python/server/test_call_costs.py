"""Every call has a cost: where it is answered, and which rate of the tenant counts it."""

import concurrent.futures
import contextlib
import json
import os
import pathlib

import grpc
import pytest
from gymnasium import make
from random_policy import export_random
from security import ADMIN, OBSERVATION, POLICY, TOKENS, Bearer, entry, service_with, until
from serving import Service, page_of, running_server, schedule_of, status_of

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
        "AmendEpisode": ("operator", {"session_id": "SESSION", "amendment_id": "a", "success": True}),
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
        "UndoCorrections": ("operator", {}),
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
                before = schedule_of(pid, "worker")[1]
                code, sizes[name] = called(services[service], name, with_session(request, session))
                print(name, cost, code, sizes[name])
                ran = schedule_of(pid, "worker")[1] > before
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


FEW, MANY = 250, 1000
PAGES = ["/status.json", "/status.json?metrics=false", "/history.json", "/sessions.json", "/metrics", "/"]
TRIES = 4
VIEWERS = 12


@pytest.fixture(scope="module")
def playing_servers(tmp_path_factory):
    """Starts servers with few and with many versions of a policy, all of which play, and yields both."""
    folder = tmp_path_factory.mktemp("policies")
    export_random(folder / "one", "small", make("CartPole-v1"))
    file = folder / "one" / "small" / "1" / "policy.safetensors"
    for versions in (FEW, MANY):
        for version in range(1, versions + 1):
            copy = folder / str(versions) / "small" / str(version) / file.name
            copy.parent.mkdir(parents=True)
            os.link(file, copy)
    tokens = folder / "tokens.json"
    any_rate = {"calls_per_second": {"listing": 0, "light": 0}}
    tenants = {name: limits | any_rate for name, limits in TOKENS["tenants"].items()}
    tokens.write_text(json.dumps(TOKENS | {"tenants": tenants}))
    with contextlib.ExitStack() as stack:
        started = []
        for versions in (FEW, MANY):
            addresses = stack.enter_context(running_server(folder / str(versions), flags=[f"--tokens={tokens}"]))
            with service_with(addresses, "agent") as agent:
                for version in range(1, versions + 1):
                    session = agent.OpenSession(policy="small", version=version).session_id
                    agent.Act(session_id=session, observation=OBSERVATION)

            def has_figures(addresses=addresses):
                status = status_of(addresses, "?metrics=false&window=100000", "watchman")
                return all(version["decisions"] == 1 for version in status["versions"])

            until(has_figures)
            started.append(addresses)
        yield started


def cost(addresses, page):
    """Returns the least processor time of some tries."""
    pid, tries = addresses.process.pid, []
    for _ in range(TRIES):
        wait_for_threads(pid)
        before = schedule_of(pid, "worker")[0]
        page_of(addresses, page, "watchman")
        wait_for_threads(pid)
        tries.append(schedule_of(pid, "worker")[0] - before)
    return min(tries)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_of_many_versions_costs_as_much_more_as_there_are(playing_servers, page):
    few, many = (cost(addresses, page) for addresses in playing_servers)
    print(f"{page}: {1000 * few:.1f} ms with {FEW} versions, {1000 * many:.1f} ms with {MANY}")
    # Four times as much in proportion, sixteen times by the square.
    assert many < 8 * few + 0.002


def test_who_waits_for_one_page_shares_it(playing_servers):
    """Twelve viewers at once cost less than four: two pages, and those of viewers who came too late for them."""
    addresses = playing_servers[1]
    pid = addresses.process.pid
    alone = cost(addresses, "/status.json")

    def together():
        wait_for_threads(pid)
        before = schedule_of(pid, "worker")[0]
        with concurrent.futures.ThreadPoolExecutor(VIEWERS) as viewers:
            pages = list(viewers.map(lambda _: status_of(addresses, token="watchman"), range(VIEWERS)))
        assert all(len(page["versions"]) == MANY for page in pages)
        wait_for_threads(pid)
        return schedule_of(pid, "worker")[0] - before

    until(lambda: together() < VIEWERS / 2 * alone, seconds=60)
