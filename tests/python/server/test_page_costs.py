"""What a page costs grows with the number of versions, and not with its square; many who wait for one share it.

It counts processor time of the server's workers, which other programs hardly change.
"""

import concurrent.futures
import contextlib
import json
import os
import pathlib

import pytest
from gymnasium import make
from random_policy import export_random
from security import OBSERVATION, TOKENS, http_body, service_with, until
from serving import running_server
from test_call_costs import wait_for_threads

FEW, MANY = 250, 1000
PAGES = ["/status.json", "/status.json?metrics=false", "/history.json", "/sessions.json", "/metrics", "/"]
TRIES = 4
VIEWERS = 12


@pytest.fixture(scope="module")
def servers(tmp_path_factory):
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
                page = http_body(addresses.http, "/status.json?metrics=false&window=100000", "Bearer watchman")
                return all(version["decisions"] == 1 for version in json.loads(page)["versions"])

            until(has_figures)
            started.append(addresses)
        yield started


def worker_seconds(pid):
    total = 0
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        if (task / "comm").read_text().strip() == "worker":
            total += int((task / "schedstat").read_text().split()[0])
    return total / 1e9


def cost(addresses, page):
    """Returns the least processor time of some tries."""
    pid, tries = addresses.process.pid, []
    for _ in range(TRIES):
        wait_for_threads(pid)
        before = worker_seconds(pid)
        http_body(addresses.http, page, "Bearer watchman")
        wait_for_threads(pid)
        tries.append(worker_seconds(pid) - before)
    return min(tries)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_of_many_versions_costs_as_much_more_as_there_are(servers, page):
    few, many = (cost(addresses, page) for addresses in servers)
    print(f"{page}: {1000 * few:.1f} ms with {FEW} versions, {1000 * many:.1f} ms with {MANY}")
    # Four times as much in proportion, sixteen times by the square.
    assert many < 8 * few + 0.002


def test_who_waits_for_one_page_shares_it(servers):
    """Twelve viewers at once cost less than four: two pages, and those of viewers who came too late for them."""
    addresses = servers[1]
    pid = addresses.process.pid
    alone = cost(addresses, "/status.json")

    def together():
        wait_for_threads(pid)
        before = worker_seconds(pid)
        with concurrent.futures.ThreadPoolExecutor(VIEWERS) as viewers:
            pages = list(viewers.map(lambda _: http_body(addresses.http, "/status.json", "Bearer watchman"), range(VIEWERS)))
        assert all(len(json.loads(page)["versions"]) == MANY for page in pages)
        wait_for_threads(pid)
        return worker_seconds(pid) - before

    until(lambda: together() < VIEWERS / 2 * alone, seconds=60)
