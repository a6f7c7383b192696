"""Opens the status page in a browser. Uses only the keyboard, in light and in dark mode.

With SPIKESERVE_SCREENSHOTS=DIR it writes the pictures of docs/ to DIR.
"""

import base64
import contextlib
import os
import pathlib
import shutil
import threading

import grpc
import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.wait import WebDriverWait

from security import ADMIN
from serving import DEADLINE_SECONDS, SHIPPED_POLICIES, Service, running_server

SESSIONS = 1000
OBSERVATION = [0.01, -0.02, 0.03, 0.1]
SCREENSHOTS = os.environ.get("SPIKESERVE_SCREENSHOTS")


def copy_policies(directory):
    """Copies the shipped CartPole policy under two names. "busy" will make more decisions."""
    for name in ("busy", "quiet"):
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", directory / name / "1")
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
        grpc.insecure_channel(addresses.grpc) as channel,
        Traffic(Service(channel, "spikeserve.v1.PolicyService")) as traffic,
    ):
        yield addresses, traffic


class Browser:
    """A headless Chromium that the test controls with the keyboard."""

    def __init__(self, driver):
        self.driver = driver

    def wait_for(self, script, what):
        """Waits until the result of a script is true, and returns it."""
        wait = WebDriverWait(self.driver, DEADLINE_SECONDS, poll_frequency=0.1)
        return wait.until(lambda driver: driver.execute_script(f"return {script}"), what)

    def tab_to(self, script, key=Keys.TAB):
        """Presses Tab until `script` is true for the element `e` that has the focus."""
        for _ in range(200):
            self.press(key)
            if self.driver.execute_script(f"const e = document.activeElement; return {script}"):
                return
        pytest.fail(f"the focus: expected an element with {script} within 200 key presses")

    def press(self, *keys):
        webdriver.ActionChains(self.driver).send_keys(*keys).perform()

    def prefer(self, scheme):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def problems(self):
        return [entry for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def screenshot(self, name, selector="body", height=None, scale=1.0):
        """Writes a picture of an element. `height` limits its height in CSS pixels."""
        if not SCREENSHOTS:
            return
        clip = self.driver.execute_script(
            """const box = document.querySelector(arguments[0]).getBoundingClientRect();
               return {x: box.x + scrollX, y: box.y + scrollY, width: box.width, height: box.height}""",
            selector,
        )
        clip["height"] = min(clip["height"], height or clip["height"])
        clip["scale"] = scale
        parameters = {"format": "png", "clip": clip, "captureBeyondViewport": True}
        picture = self.driver.execute_cdp_cmd("Page.captureScreenshot", parameters)["data"]
        path = pathlib.Path(SCREENSHOTS) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(picture))


@contextlib.contextmanager
def chromium():
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    # The sandbox of Chromium does not start as root in a container, where the tests may run.
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "hide-scrollbars", "window-size=1280,900"):
        options.add_argument(f"--{argument}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService("/usr/bin/chromedriver")
    driver = webdriver.Chrome(options=options, service=service)
    try:
        yield Browser(driver)
    finally:
        driver.quit()


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def page(browser, server):
    """Opens the page and waits until it shows numbers."""
    addresses, _ = server
    browser.prefer("light")
    browser.driver.get(f"http://{addresses.http}/")
    browser.wait_for("/[0-9] .?J\\/s/.test(document.querySelector('#most-energy').textContent)", "power")
    browser.wait_for("document.querySelectorAll('#sessions-table tbody tr').length === 50", "sessions")
    yield browser
    assert browser.problems() == []


def text(page, selector):
    return page.driver.find_element(By.CSS_SELECTOR, selector).text


def rows(page, table):
    script = f"""return [...document.querySelectorAll('#{table} tbody tr')]
                   .map((row) => [...row.cells].map((cell) => cell.textContent))"""
    return page.driver.execute_script(script)


def test_which_policy_costs_the_most_energy_is_said_in_words_and_on_top(page):
    assert text(page, "#most-energy").startswith("Most energy: busy/1 (")
    assert "estimated by horowitz_45nm" in text(page, "#most-energy")
    [first, second] = rows(page, "policies-table")
    assert first[0] == "busy/1"
    assert second[0] == "quiet/1"
    assert first[1].endswith("J/s")


def test_all_columns_are_in_view(page):
    hidden = """[...document.querySelectorAll('.scroll')]
        .filter((e) => e.scrollWidth > e.clientWidth).map((e) => e.getAttribute('aria-labelledby'))"""
    assert page.driver.execute_script(f"return {hidden}") == []


def test_returns_and_learning_are_shown(page, server):
    addresses, _ = server
    with grpc.insecure_channel(addresses.grpc) as channel:
        service = Service(channel, "spikeserve.v1.PolicyService")
        session = service.OpenSession(
            policy="quiet", action_selection="SAMPLE", learning={"modulator": "realized"}
        ).session_id
        for step in range(3):
            service.Act(session_id=session, step=step, observation=OBSERVATION, reward=2.0)
        ended = service.EndEpisode(session_id=session, reward=3.0, terminated=True)
        service.CloseSession(session_id=session)
    assert ended.learning.updates == 1
    shown = "document.querySelector('#returns-table tbody').textContent"
    page.wait_for(f"{shown}.includes('100 %{ended.episode_return:.1f}1')", "the episode")
    [row] = [row for row in rows(page, "returns-table") if row[0] == "quiet/1"]
    assert row[:5] == ["quiet/1", "CartPole-v1 full (default)", "100 %", "7.0", "1"]
    assert float(row[5]) == pytest.approx(ended.learning.head_drift, abs=1e-4)


def test_traffic_and_rollouts_are_shown(browser, tmp_path):
    for version in ("1", "2"):
        shutil.copytree(SHIPPED_POLICIES / "cartpole" / "1", tmp_path / "robot" / version)
    with running_server(tmp_path) as addresses, grpc.insecure_channel(addresses.grpc) as channel:
        admin = Service(channel, ADMIN)
        admin.SetDefaultVersion(policy="robot", version=1)
        admin.SetLabel(policy="robot", version=1, label="stable")
        admin.SetShadow(policy="robot", shadow_version=2)
        admin.StartRollout(policy="robot", version=2, steps=[25])
        browser.driver.get(f"http://{addresses.http}/")
        browser.wait_for("document.querySelectorAll('#rollouts-table tbody tr').length === 1", "the roll-out")
        [rollout] = rows(browser, "rollouts-table")
        assert rollout[:4] == ["robot/2", "running", "25", "0"]
        assert rollout[-1].startswith("waits for ")
        assert [row[2] for row in rows(browser, "returns-table")] == [
            "75 % stable",
            "25 % (shadow) (roll-out running)",
        ]
        assert browser.problems() == []


def test_every_stage_and_call_is_there(page):
    head = page.driver.execute_script(
        "return [...document.querySelectorAll('#stages-table th')].map((cell) => cell.textContent)"
    )
    stages = ["coder", "phase", "query", "key", "value", "ffn_in", "ffn_hidden", "readout"]
    assert head == ["Policy", *stages, "all"]
    for row in rows(page, "stages-table"):
        figures = [float(cell) for cell in row[1:]]
        assert sum(figures[:-1]) == pytest.approx(figures[-1], abs=0.5)
    page.tab_to("e.id === 'stage-unit'")
    page.press("j")
    for row in rows(page, "stages-table"):
        assert all(cell == "–" or cell.endswith("J") for cell in row[1:]), row
    assert "Act" in [row[0] for row in rows(page, "calls-table")]
    assert len(page.driver.find_elements(By.CSS_SELECTOR, ".uplot canvas")) == 4


def test_a_thousand_sessions_are_paged_and_filtered_by_keyboard(page):
    assert text(page, "#page") == "1 to 50 of 1,000 sessions"
    page.tab_to("e.id === 'next'")
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#page').textContent.startsWith('51 to 100')", "page 2")
    page.tab_to("e.id === 'filter'", Keys.SHIFT + Keys.TAB)
    page.press("quiet/1")
    page.wait_for(
        "document.querySelector('#page').textContent === '1 to 50 of 100, of 1,000 sessions'", "filter"
    )
    assert {row[1] for row in rows(page, "sessions-table")} == {"quiet/1"}


def test_tables_are_sorted_by_keyboard(page):
    column = "e.closest('#policies-table th')?.textContent === 'Policy'"
    page.tab_to(column)
    page.press(Keys.ENTER)
    page.wait_for("document.querySelector('#policies-table th').ariaSort === 'ascending'", "sort")
    page.press(Keys.SPACE)
    page.wait_for("document.querySelector('#policies-table th').ariaSort === 'descending'", "sort")
    assert [row[0] for row in rows(page, "policies-table")] == ["quiet/1", "busy/1"]
    assert page.driver.execute_script(f"const e = document.activeElement; return {column}")


def test_a_decision_is_explained_by_keyboard(page):
    page.tab_to("e.id === 'pause'")
    page.press(Keys.SPACE)
    page.tab_to("e.closest('#sessions-table td') !== null")
    session = page.driver.execute_script("return document.activeElement.textContent")
    page.press(Keys.ENTER)
    page.wait_for("document.activeElement.id === 'decision'", "the decision")
    assert session in text(page, "#decision-body table")
    maps = page.driver.execute_script(
        "return [...document.querySelectorAll('#decision canvas')].map((map) => map.ariaLabel)"
    )
    assert any(label.startswith("phase: ") for label in maps)
    for start in ("coder: ", "query: ", "key: ", "value: ", "ffn_in: ", "ffn_hidden: "):
        assert sum(label.startswith(start) for label in maps) == 2, f"{start} of two layers"
    assert sum(label.startswith("routing gates") for label in maps) == 2
    assert sum(label.startswith("attention") for label in maps) == 2
    drawn = """[...document.querySelectorAll('#decision canvas')].some((map) => {
        const data = map.getContext('2d').getImageData(0, 0, map.width, map.height).data;
        return data.some((value, i) => value !== data[i % 4]);
    })"""
    assert page.driver.execute_script(f"return {drawn}")
    page.screenshot("decision-light.png", "#decision", scale=0.6)
    page.tab_to("e.id === 'explain-again'")
    page.press(Keys.ENTER)
    page.tab_to("e.id === 'token'")
    page.press("s")
    page.wait_for(
        "document.querySelectorAll('#decision canvas[aria-label*=\" of a \"]').length === 0", "state"
    )


def test_what_cannot_be_explained_is_said(page, server):
    addresses, _ = server
    with grpc.insecure_channel(addresses.grpc) as channel:
        service = Service(channel, "spikeserve.v1.PolicyService")
        session = service.OpenSession(policy="quiet").session_id
        page.tab_to("e.id === 'filter'")
        page.press(session)
        page.wait_for("document.querySelectorAll('#sessions-table tbody tr').length === 1", "filter")
        page.tab_to("e.closest('#sessions-table td') !== null")
        page.press(Keys.ENTER)
        page.wait_for("document.querySelector('#decision-error').textContent.includes('step 0')", "error")
        service.CloseSession(session_id=session)
    # Chromium reports the expected HTTP status 409 in its console.
    assert all("409" in entry["message"] for entry in page.problems())


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
return ['body', '.note', 'td', 'th button', 'footer a', '#totals dt', 'figcaption', '.u-legend', 'select', '#pause']
  .map((selector) => {
    const e = document.querySelector(selector);
    const [a, b] = [luminance(getComputedStyle(e).color), luminance(groundOf(e))];
    return [selector, (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), b];
  });
"""


# Counts the pixels in the colour of the first policy.
LINE_IS_DRAWN = """(() => {
  const canvas = document.querySelector('#chart-decisions canvas');
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
    if SCREENSHOTS:  # waits until the charts have 20 samples
        asked = "performance.getEntriesByType('resource').filter((entry) => entry.name.endsWith('status.json'))"
        page.wait_for(f"{asked}.length > 20", "twenty samples")
    page.screenshot(f"status-{scheme}.png", height=1360)


def test_nothing_comes_from_elsewhere(page, server):
    addresses, _ = server
    requested = page.driver.execute_script(
        "return performance.getEntriesByType('resource').map((entry) => entry.name)"
    )
    assert requested
    assert all(url.startswith(f"http://{addresses.http}/") for url in requested)
