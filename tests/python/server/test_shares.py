"""Sessions, tokens and versions: one tenant's share, and what is given back."""

import concurrent.futures
import contextlib
import json
import os
import shutil
import statistics
import time

import grpc
import pytest
from security import ADMIN, OBSERVATION, POLICY, TOKENS, code_of, entry, service_with, until
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, message_class, page_of, running_server

from tests.attacks.process import MEGABYTE, Process

LISTED_SESSIONS = int(os.environ.get("SPIKESERVE_LISTED_SESSIONS", 20_000))
TOKENS_IN_FILE = 20_000
RELOADS = 12
VERSIONS = 225
TIME_TO_LIVE = 1.0


@contextlib.contextmanager
def served(tmp_path, *flags, policies=SHIPPED_POLICIES, tokens=TOKENS):
    """Starts a server without rates of calls, because the tests make as many as the machine can."""
    any_rate = {"calls_per_second": {"light": 0, "listing": 0, "explain": 0, "operator": 0}}
    tenants = {name: any_rate | limits for name, limits in tokens["tenants"].items()}
    path = tmp_path / "tokens.json"
    path.write_text(json.dumps(tokens | {"tenants": tenants}))
    with running_server(policies, flags=[f"--tokens={path}", *flags]) as addresses:
        yield addresses


def open_until_refused(service):
    opened = 0
    while (code := code_of(service.OpenSession, policy="cartpole")) == grpc.StatusCode.OK:
        opened += 1
    assert code == grpc.StatusCode.RESOURCE_EXHAUSTED
    return opened


def test_one_tenant_opens_half_of_the_sessions(tmp_path):
    more = TOKENS | {"tenants": TOKENS["tenants"] | {"slow": {"max_sessions": 8}}}
    with (
        served(tmp_path, "--max_sessions=10", tokens=more) as addresses,
        service_with(addresses, "agent") as agent,
        service_with(addresses, "rival") as rival,
    ):
        assert open_until_refused(agent) == 5
        assert open_until_refused(rival) == 5
    with (
        served(tmp_path, "--max_sessions=10", tokens=more) as addresses,
        service_with(addresses, "slow") as slow,
    ):
        assert open_until_refused(slow) == 8  # its own limit


def test_a_single_tenant_opens_all_sessions(tmp_path):
    alone = {"tenants": {"fleet": {}}, "tokens": [entry("agent", "agent")]}
    with (
        served(tmp_path, "--max_sessions=10", tokens=alone) as addresses,
        service_with(addresses, "agent") as agent,
    ):
        assert open_until_refused(agent) == 10


def open_many(addresses, count):
    request = message_class(addresses.channel, "spikeserve.v1.OpenSessionRequest")(
        policy="cartpole-small", labels={"robot": "x" * 40}
    ).SerializeToString()
    call = addresses.channel.unary_unary(f"/{POLICY}/OpenSession")
    metadata = [("authorization", "Bearer agent")]
    for start in range(0, count, 500):
        calls = [
            call.future(request, metadata=metadata, timeout=DEADLINE_SECONDS)
            for _ in range(start, min(start + 500, count))
        ]
        for opened in calls:
            opened.result()


def test_lists_of_sessions_need_memory_for_one_page(tmp_path):
    alone = {
        "tenants": {"fleet": {}},
        "tokens": [entry("agent", "agent"), entry("viewer", "viewer")],
    }
    with (
        served(tmp_path, tokens=alone) as addresses,
        service_with(addresses, "viewer", ADMIN) as viewer,
    ):
        open_many(addresses, LISTED_SESSIONS)
        process = Process(addresses.process.pid)
        idle = process.memory()
        process.reset_peak()

        seconds = []

        def read_pages(_):
            token = ""
            for _ in range(5):
                query = f"sort=energy_joules&order=descending&filter=robot&page_size=50&page_token={token}"
                start = time.perf_counter()
                page = json.loads(page_of(addresses, f"/sessions.json?{query}", "viewer"))
                seconds.append(time.perf_counter() - start)
                token = page["next_page_token"]
                yield page

        with concurrent.futures.ThreadPoolExecutor(8) as readers:
            readings = list(readers.map(lambda reader: list(read_pages(reader)), range(8)))
        for pages in readings:
            assert all(page["matching"] == LISTED_SESSIONS for page in pages)
            assert len({session["session_id"] for page in pages for session in page["sessions"]}) == 250
        seen, token = [], ""
        for _ in range(5):
            listed = viewer.ListSessions(page_size=1000, page_token=token)
            seen += [session.session_id for session in listed.sessions]
            token = listed.next_page_token
        assert len(set(seen)) == 5000 and seen == sorted(seen)
        growth = process.peak() - idle
        print(
            f"8 readers of {LISTED_SESSIONS} sessions, sorted and filtered: median "
            f"{1000 * statistics.median(seconds):.1f} ms, at most {1000 * max(seconds):.1f} ms, "
            f"{growth / MEGABYTE:.1f} MB"
        )
        assert growth < 20 * MEGABYTE


def test_tokens_that_were_removed_occupy_no_memory(tmp_path):
    def tokens(generation):
        more = [entry(f"{generation}-{i}", "agent") for i in range(TOKENS_IN_FILE)]
        return TOKENS | {"tokens": TOKENS["tokens"] + more}

    with served(tmp_path, tokens=tokens(0)) as addresses:
        process = Process(addresses.process.pid)
        warm = None
        for generation in range(1, RELOADS + 1):
            renewed = tmp_path / "renewed.json"
            renewed.write_text(json.dumps(tokens(generation)))
            renewed.rename(tmp_path / "tokens.json")
            with service_with(addresses, f"{generation}-7") as agent:
                until(lambda: code_of(agent.ListPolicies) == grpc.StatusCode.OK)
            if generation == 3:
                warm = process.memory()
        until(lambda: process.memory() < warm + 8 * MEGABYTE)


def test_versions_that_were_unloaded_leave_nothing(tmp_path):
    source = SHIPPED_POLICIES / "cartpole-small" / "1"
    policies = tmp_path / "policies"
    shutil.copytree(source, policies / "small" / "1")
    with (
        served(tmp_path, policies=policies) as addresses,
        service_with(addresses, "operator", ADMIN) as admin,
    ):
        process = Process(addresses.process.pid)
        warm = None
        for _ in range(2):  # the first time shows what the allocator keeps
            for version in range(2, VERSIONS + 1):
                shutil.copytree(source, policies / "small" / str(version))
                admin.LoadPolicy(policy="small", version=version)
            for version in range(2, VERSIONS + 1):
                shutil.rmtree(policies / "small" / str(version))
            assert len(admin.ReloadPolicies().unloaded) == VERSIONS - 1
            page = page_of(addresses, "/metrics", "viewer")
            assert 'version="1"' in page and 'version="2"' not in page
            if warm is None:
                warm = process.memory()
        until(lambda: process.memory() < warm + 24 * MEGABYTE)  # the versions took 200


def test_names_that_nothing_has_are_not_stored(tmp_path):
    with (
        served(tmp_path) as addresses,
        service_with(addresses, "operator", ADMIN) as admin,
    ):
        process = Process(addresses.process.pid)
        long_label = {"policy": "cartpole", "version": 2, "label": "x" * 100_000}
        assert code_of(admin.SetLabel, **long_label) == grpc.StatusCode.INVALID_ARGUMENT
        admin.SetLabel(policy="cartpole", version=2, label="x" * 128)
        idle = process.memory()
        for i in range(3000):
            absent = code_of(admin.LoadPolicy, policy=f"absent-{i}", version=1)
            assert absent == grpc.StatusCode.NOT_FOUND
            name = f"{i}-" + "y" * 4000
            invalid = code_of(admin.LoadPolicy, policy=name, version=1)
            assert invalid == grpc.StatusCode.INVALID_ARGUMENT
        until(lambda: process.memory() < idle + 10 * MEGABYTE)


@pytest.mark.parametrize("attempt", range(3))
def test_a_server_that_was_stopped_reads_requests_before_it_reaps(tmp_path, attempt):
    flags = [f"--session_ttl={TIME_TO_LIVE}s", f"--compact_after={TIME_TO_LIVE}s"]
    with (
        served(tmp_path, *flags) as addresses,
        service_with(addresses, "agent") as agent,
    ):
        request_class = message_class(addresses.channel, "spikeserve.v1.ActRequest")
        act = addresses.channel.unary_unary(
            f"/{POLICY}/Act", request_serializer=request_class.SerializeToString
        )
        sessions = [agent.OpenSession(policy="cartpole").session_id for _ in range(20)]

        def acts(step):
            return [
                act.future(
                    request_class(session_id=session, step=step, observation=OBSERVATION),
                    metadata=[("authorization", "Bearer agent")],
                    timeout=DEADLINE_SECONDS,
                )
                for session in sessions
            ]

        for call in acts(0):
            call.result()
        addresses.stop()
        waiting = acts(1)
        time.sleep(3 * TIME_TO_LIVE)  # longer than the time-to-live, which is what is tested
        addresses.resume()
        for call in waiting:
            call.result()
