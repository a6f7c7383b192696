"""The status page of a server shows the others that share its store in Redis."""

import pytest
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import POLICY, until
from serving import Service, running_server, status_of
from stored_sessions import Restartable
from test_status_json import validate

pytestmark = WITHOUT_REDIS


@pytest.fixture
def servers():
    """Starts two servers with one store, of which the second one has three sessions that have decided."""
    with stopping([Redis(password="")]) as [redis]:
        started = [Restartable(f"redis://127.0.0.1:{redis.port}") for _ in range(2)]
        for server in started:
            server.start()
        agent = Service(started[1].channel, POLICY)
        for _ in range(3):
            session = agent.OpenSession(policy="cartpole", version=2).session_id
            agent.Act(session_id=session, step=0, observation=[0.0, 0.1, 0.0, -0.1])
        yield *started, redis
        for server in started:
            server.close()


def told(server):
    """Returns what a server shows about each server, by its address."""
    return {row["address"]: row for row in status_of(server)["servers"]}


def test_each_server_shows_what_the_others_do(servers):
    first, second, _ = servers
    until(lambda: told(first).get(second.addresses.http, {}).get("sessions") == 3)
    until(lambda: set(told(first)) == {first.addresses.http, second.addresses.http} == set(told(second)))
    validate("status", status_of(first))
    until(lambda: told(first)[second.addresses.http]["playing"] == ["cartpole/2"])
    row, own = told(first)[second.addresses.http], told(first)[first.addresses.http]
    assert (row["serving"], own["serving"]) == (True, True)
    assert row["decisions_per_second"] > 0
    assert (own["sessions"], own["playing"]) == (0, [])
    assert status_of(first)["replica"] == own["replica"] != row["replica"]


def test_the_page_lists_them_and_says_who_is_lost(browser, servers):
    first, second, _ = servers
    until(lambda: told(first).get(second.addresses.http, {}).get("sessions") == 3)
    browser.open(f"http://{first.addresses.http}/")
    browser.wait_for("document.querySelectorAll('#servers-table tbody tr').length === 2", "both servers")
    rows = {row["Server"]: row for row in browser.records("servers-table")}
    assert rows[second.addresses.http]["Health"] == "healthy"
    assert rows[second.addresses.http]["Sessions"] == "3"
    assert browser.text("#servers-sum").startswith("2 of 2 alive, with 3 sessions and ")
    assert browser.evaluate("[...document.querySelectorAll('#servers-table a')].map((e) => e.host).sort()") == sorted(rows)
    second.kill()
    browser.wait_for("document.querySelector('#servers-table .bad')?.textContent.startsWith('no sign of life')", "the loss")
    [lost] = [row for row in browser.records("servers-table") if row["Health"] != "healthy"]
    assert lost["Server"] == second.addresses.http
    assert browser.text("#servers-sum").startswith("1 of 2 alive, with 0 sessions and ")
    assert browser.problems() == []


def test_a_server_that_ends_leaves_the_list(servers):
    first, second, redis = servers
    addresses = {first.addresses.http, second.addresses.http}
    with running_server(flags=[f"--session_store=redis://127.0.0.1:{redis.port}"]) as third:
        until(lambda: set(told(first)) == addresses | {third.http})
    until(lambda: set(told(first)) == addresses)


def test_what_is_no_report_is_not_shown(servers):
    first, second, redis = servers
    milliseconds = int(redis.command("TIME")[0]) * 1000
    written = {"a": "nonsense", "b": f"{milliseconds} {{", "c": f"{milliseconds} 7"}
    written["d"] = f'{milliseconds} {{\\"address\\": \\"ghost\\"}}'
    for name, text in written.items():
        assert redis.command(f'HSET pf:servers {name} "{text}"') == 1
    until(lambda: set(told(first)) == {first.addresses.http, second.addresses.http, "ghost"})


def test_a_server_without_others_tells_nothing():
    server = Restartable("memory")
    server.start()
    try:
        assert status_of(server)["servers"] == []
    finally:
        server.close()
