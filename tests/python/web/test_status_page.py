"""Opens the status page of a server with 1,000 sessions, and of servers that share a store, in a browser.

Uses only the keyboard, by day and by night.
"""

import itertools
import json
import threading

import pytest
from policy_file import copy_without_wiring, read_policy, write_policy
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import until
from selenium.webdriver.common.keys import Keys
from serving import SHIPPED_POLICIES, running_server, status_of
from stored_sessions import Restartable, replicas_on
from test_status_json import validate

SESSIONS = 1000
OBSERVATION = [0.01, -0.02, 0.03, 0.1]


def copy_policies(directory):
    """Copies the shipped CartPole policy under two names. "busy" will make more decisions, of which no observation changes."""
    for name in ("busy", "quiet"):
        copy_without_wiring(SHIPPED_POLICIES / "cartpole" / "2", directory / name / "1")
    return directory


class Traffic:
    """Opens 1,000 sessions. Some of them make decisions until the end of the block."""

    def __init__(self, service):
        self._service = service
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play)
        self.sessions = []

    def __enter__(self):
        for i in range(SESSIONS):
            policy = "quiet" if i % 10 == 0 else "busy"
            session = self._service.OpenSession(policy=policy, labels={"robot": f"r{i}"}).session_id
            self.sessions.append(session)
        for session in self.sessions:
            self._service.Act(session_id=session, step=0, observation=OBSERVATION)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()

    def _play(self):
        step = 1
        while not self._stop.is_set():
            for session in self.sessions[:40]:
                self._service.Act(session_id=session, step=step, observation=OBSERVATION, reward=1.0)
            step += 1


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with (
        running_server(copy_policies(tmp_path_factory.mktemp("policies"))) as addresses,
        Traffic(addresses.agent) as traffic,
    ):
        yield addresses, traffic


@pytest.fixture
def page(browser, server):
    """Opens the page and waits until it shows numbers."""
    addresses, _ = server
    browser.prefer("light")
    browser.open(f"http://{addresses.http}/")
    browser.wait_for("document.querySelector('#most-energy strong')", "power")
    browser.wait_for("document.querySelectorAll('#sessions-table tbody tr').length === 50", "sessions")
    yield browser
    assert browser.problems() == []


def test_which_policy_costs_the_most_energy_is_said_in_words_and_on_top(page):
    assert page.text("#most-energy").startswith("Most energy: busy/1 (")
    assert "estimated by int_sram_45nm" in page.text("#most-energy")
    [first, second] = page.records("policies-table")
    assert first["Policy"] == "busy/1"
    assert second["Policy"] == "quiet/1"
    assert first["Energy per second"].endswith("J")


def test_energy_stands_beside_that_of_a_dense_policy(page, server):
    addresses, _ = server
    [row, _] = status_of(addresses, "?metrics=false")["versions"]
    dense = row["dense_energy_joules_per_decision"]["int_sram_45nm"]
    energy, note, _ = page.tiles()["Energy / decision"]
    assert energy.endswith(" nJ") and note == f"dense: {dense * 1e6:.3g} µJ"
    cell = page.evaluate("""(() => {
        const cell = document.querySelector("#policies-table td[data-label='Energy per decision']");
        return [cell.title, parseFloat(cell.style.getPropertyValue('--share'))];
    })()""")
    assert cell[0] == f"dense baseline: {dense * 1e6:.3g} µJ"
    assert cell[1] == pytest.approx(100 * float(energy.removesuffix(" nJ")) * 1e-9 / dense, rel=0.2)


def test_the_energy_model_is_chosen_among_those_of_the_server(page):
    models = "[...document.querySelectorAll('#energy-model option')].map((option) => option.value)"
    assert {"horowitz_45nm", "spike_5pj"} <= set(page.evaluate(models))
    page.tab_to("e.id === 'energy-model'")
    page.press("s")
    page.wait_for("document.querySelector('#most-energy').textContent.includes('by spike_5pj')", "the other model")
    assert page.text("#most-energy").startswith("Most energy: busy/1 (")


def test_all_columns_are_in_view(page):
    hidden = """[...document.querySelectorAll('.scroll')]
        .filter((e) => e.scrollWidth > e.clientWidth).map((e) => e.ariaLabel ?? e.getAttribute('aria-labelledby'))"""
    assert page.evaluate(hidden) == []


def test_tiles_and_charts_are_on_the_first_screen(page):
    tiles = page.tiles()
    assert tiles["Health"][0] == "healthy"
    assert tiles["Sessions"][0] == "1,000"
    assert not any(red for _, _, red in tiles.values())
    page.wait_for("document.querySelectorAll('#charts .uplot canvas').length === 4", "charts")
    bottoms = """[...document.querySelectorAll('#tiles > div, #charts figure, #most-energy')]
        .map((e) => e.getBoundingClientRect().bottom)"""
    assert max(page.evaluate(bottoms)) < page.evaluate("innerHeight")
    drawn = "document.querySelectorAll('#tiles svg:not(.none) path[d*=L]').length"
    page.wait_for(f"{drawn} >= 4", "sparklines")


def test_returns_and_learning_are_shown(page, server):
    addresses, _ = server
    session = addresses.agent.OpenSession(
        policy="quiet", action_selection="SAMPLE", learning={"modulator": "realized"}
    ).session_id
    for step in range(3):
        addresses.agent.Act(session_id=session, step=step, observation=OBSERVATION, reward=2.0)
    ended = addresses.agent.EndEpisode(session_id=session, reward=3.0, terminated=True)
    addresses.agent.CloseSession(session_id=session)
    assert ended.learning.updates == 1
    shown = "[...document.querySelectorAll('#policies-table td')].map((cell) => cell.textContent)"
    page.wait_for(f"{shown}.includes('{ended.episode_return:.1f}')", "the episode")
    [row] = [row for row in page.records("policies-table") if row["Policy"] == "quiet/1"]
    assert row["New sessions"] == "default"
    assert (row["Return"], row["Episodes"]) == ("7.0", "1")
    assert float(row["Head drift"]) == pytest.approx(ended.learning.head_drift, abs=1e-4)
    assert page.tiles()["Episode return"][:2] == ("7.0", "1 episode")


def test_traffic_and_rollouts_are_shown(browser, tmp_path):
    for version, lost in ("1", 0.0), ("2", 0.031):
        tensors, metadata = read_policy(SHIPPED_POLICIES / "cartpole" / "2" / "policy.safetensors")
        metadata["training"] = json.dumps(json.loads(metadata["training"]) | {"rounding_loss": {"share": lost}})
        write_policy(tmp_path / "robot" / version / "policy.safetensors", tensors, metadata)
    with running_server(tmp_path) as addresses:
        addresses.admin.SetDefaultVersion(policy="robot", version=1)
        addresses.admin.SetLabel(policy="robot", version=1, label="stable")
        addresses.admin.SetShadow(policy="robot", shadow_version=2)
        addresses.admin.StartRollout(policy="robot", version=2, steps=[25])
        browser.driver.get(f"http://{addresses.http}/")
        browser.wait_for("document.querySelector('#comparisons article')", "the roll-out")
        assert browser.text("#comparisons h3") == "Roll-out of robot/2: running"
        assert browser.text("#comparisons .verdict") == "robot/2 has too few episodes to judge its return."
        assert browser.text("#comparisons .loss") == "robot/1 lost 0 % by rounding, robot/2 lost 3.1 % by rounding."
        assert browser.text("#comparisons .quiet").startswith("waits for ")
        assert browser.text("#comparisons .steps .current") == "25 %"
        browser.click("#idle")
        browser.wait_for("document.querySelectorAll('#policies-table tbody tr').length === 2", "both versions")
        chips = """[...document.querySelectorAll('#policies-table tbody tr')].map((row) =>
            [...row.querySelectorAll('.chip')].map((chip) => chip.textContent).join(', ')).sort()"""
        assert browser.evaluate(chips) == ["25 %, shadow, roll-out running", "75 %, stable"]
        addresses.admin.AbortRollout(policy="robot")
        addresses.admin.SetTrafficShares(policy="robot", shares=[{"version": 1, "percent": 90}, {"version": 2, "percent": 10}])
        title = "document.querySelector('#comparisons article:last-child h3').textContent"
        browser.wait_for(f"{title} === 'Shares of robot'", "shares")
        assert browser.problems() == []
    # The server is gone.
    browser.wait_for("/^no answer for [0-9]+ s: /.test(document.querySelector('#health').textContent)", "health")
    assert browser.evaluate("document.querySelector('#health').classList.contains('bad')")
    browser.problems()  # Chromium reports the connections that failed


def test_every_stage_and_call_is_there(page):
    page.tab_to("e.textContent === 'Spikes per decision, by stage'")
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#stages').open", "the stages")
    stages = ["coder", "phase", "query", "key", "value", "ffn_in", "ffn_hidden", "readout"]
    for row in page.records("stages-table"):
        assert list(row) == ["Policy", *stages, "all"]
        figures = [float(row[stage]) for stage in stages]
        assert sum(figures) == pytest.approx(float(row["all"]), abs=0.5)
    page.tab_to("e.id === 'stage-unit'")
    page.press("j")
    for row in page.rows("stages-table"):
        assert all(cell.endswith("J") for cell in row[1:]), row
    assert "Act" in [row["Method"] for row in page.records("calls-table")]


def test_a_thousand_sessions_are_paged_and_filtered_by_keyboard(page):
    assert page.text("#page") == "1 to 50 of 1,000 sessions"
    page.tab_to("e.id === 'next'")
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#page').textContent.startsWith('51 to 100')", "page 2")
    page.tab_to("e.id === 'previous'", Keys.SHIFT + Keys.TAB)
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#page').textContent.startsWith('1 to 50')", "page 1")
    page.tab_to("e.id === 'filter'", Keys.SHIFT + Keys.TAB)
    page.press("quiet/1")
    page.wait_for(
        "document.querySelector('#page').textContent === '1 to 50 of 100, of 1,000 sessions'", "filter"
    )
    assert {row["Policy"] for row in page.records("sessions-table")} == {"quiet/1"}


def test_tables_are_sorted_by_keyboard(page):
    column = "e.closest('#policies-table th')?.textContent === 'Policy'"
    page.tab_to(column)
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#policies-table th').ariaSort === 'ascending'", "sort")
    page.press(Keys.SPACE)
    page.wait_for("document.querySelector('#policies-table th').ariaSort === 'descending'", "sort")
    assert [row["Policy"] for row in page.records("policies-table")] == ["quiet/1", "busy/1"]
    assert page.driver.execute_script(f"const e = document.activeElement; return {column}")


def test_a_decision_is_explained_by_keyboard(page):
    page.tab_to("e.closest('#sessions-table td') !== null")
    session = page.evaluate("document.activeElement.title")
    page.press(Keys.ENTER)
    page.wait_for("document.activeElement.id === 'session'", "the session")
    assert page.text("#scope code") == session
    page.wait_for("document.querySelectorAll('#decision canvas').length >= 14", "the decision")
    described = page.evaluate(
        "[...document.querySelectorAll('#decision [aria-label]')].map((map) => map.ariaLabel)"
    )
    assert any(label.startswith("phase: ") for label in described)
    for start in ("coder: ", "query: ", "key: ", "value: ", "ffn_in: ", "ffn_hidden: "):
        assert sum(label.startswith(start) for label in described) == 2, f"{start} of two layers"
    assert sum(label.startswith("routing gates") for label in described) == 2
    assert sum(label.startswith("attention") for label in described) == 2
    drawn = """[...document.querySelectorAll('#decision canvas')].some((map) => {
        const data = map.getContext('2d').getImageData(0, 0, map.width, map.height).data;
        return data.some((value, i) => value !== data[i % 4]);
    })"""
    assert page.evaluate(drawn)
    page.tab_to("e.id === 'token'")
    page.press("s")
    rasters = "[...document.querySelectorAll('#decision canvas[aria-label*=ticks]')]"
    page.wait_for(f"{rasters}.every((map) => map.ariaLabel.endsWith(' of s'))", "the state token alone")


def test_what_cannot_be_explained_is_said(page, server):
    addresses, _ = server
    session = addresses.agent.OpenSession(policy="quiet").session_id
    page.tab_to("e.id === 'filter'")
    page.press(session)
    page.wait_for("document.querySelectorAll('#sessions-table tbody tr').length === 1", "filter")
    page.tab_to("e.closest('#sessions-table td') !== null")
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#decision-error').textContent.includes('step 0')", "error")
    addresses.agent.CloseSession(session_id=session)
    # Chromium reports the expected HTTP statuses 409 and, after the end of the session, 404 in its console.
    assert all("409" in entry["message"] or "404" in entry["message"] for entry in page.problems())


def test_a_robot_that_misses_beats_is_shown(page, server):
    addresses, _ = server
    session = addresses.agent.OpenSession(policy="quiet", period_seconds=0.02, labels={"robot": "late-7"}).session_id
    report, steps = {"fresh": 10, "held": 5, "local": 3, "safe": 2}, itertools.count()

    def is_in_the_alerts():
        report["held"] += 1
        addresses.agent.Act(session_id=session, step=next(steps), observation=OBSERVATION, reward=1.0, report=report)
        return "SpikeserveRobotsWithoutActions" in page.text("#alerts")

    until(is_in_the_alerts)
    page.tab_to("e.id === 'filter'")
    page.press("robot=late-7")
    missed = f"{report['held'] + 5} of {report['held'] + 15}, silent"
    page.wait_for(f"document.querySelector('#sessions-table tbody tr').textContent.includes('{missed}')", "beats")
    addresses.agent.CloseSession(session_id=session)


CONTRAST = """
const luminance = (colour) => {
  const [r, g, b] = colour.match(/[0-9.]+/g).map((x) => x / 255)
    .map((x) => (x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const groundOf = (e) => {
  const colour = getComputedStyle(e).backgroundColor;
  return colour === 'rgba(0, 0, 0, 0)' ? groundOf(e.parentElement) : colour;
};
return ['body', '#page', 'td', 'th button', 'footer a', '#tiles dt', '#tiles .quiet', 'figcaption', 'select', '#pause']
  .map((selector) => {
    const e = document.querySelector(selector);
    const [a, b] = [luminance(getComputedStyle(e).color), luminance(groundOf(e))];
    return [selector, (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), b];
  });
"""


# Counts the pixels in the colour of the first policy.
LINE_IS_DRAWN = """(() => {
  const canvas = document.querySelector('#charts canvas');
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  let pixels = 0;
  for (let i = 0; i < data.length; i += 4) {
    pixels += data[i] === 0x00 && data[i + 1] === 0x72 && data[i + 2] === 0xb2;
  }
  return pixels > 100;
})()"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_by_day_and_by_night(page, scheme):
    page.prefer(scheme)
    page.wait_for(LINE_IS_DRAWN, "a line in the first chart")
    for selector, contrast, ground in page.driver.execute_script(CONTRAST):
        assert contrast >= 4.5, f"WCAG's contrast of {selector}"
        assert (ground > 0.5) == (scheme == "light"), f"the background of {selector}"


def test_nothing_comes_from_elsewhere(page, server):
    addresses, _ = server
    requested = page.driver.execute_script(
        "return performance.getEntriesByType('resource').map((entry) => entry.name)"
    )
    assert requested
    assert all(url.startswith(f"http://{addresses.http}/") for url in requested)


pytestmark = WITHOUT_REDIS


@pytest.fixture
def servers():
    """Starts two servers with one store, of which the second one has three sessions that have decided."""
    with stopping([Redis(password="")]) as [redis], replicas_on(redis) as (first, second):
        for _ in range(3):
            session = second.OpenSession(policy="cartpole", version=2).session_id
            second.Act(session_id=session, step=0, observation=[0.0, 0.1, 0.0, -0.1])
        yield first, second, redis


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
    for name, address in (("d", "ghost"), ('"\\xff"', "bytes")):
        written[name] = f'{milliseconds} {{\\"address\\": \\"{address}\\"}}'
    for name, text in written.items():
        assert redis.command(f'HSET pf:servers {name} "{text}"') == 1
    until(lambda: set(told(first)) == {first.addresses.http, second.addresses.http, "ghost", "bytes"})


def test_a_server_without_others_tells_nothing():
    with Restartable("memory") as server:
        assert status_of(server)["servers"] == []
