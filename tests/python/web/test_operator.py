"""An operator answers questions with the status page alone, in headless Chromium.

The server is real, and robots play real tasks. With SPIKESERVE_SCREENSHOTS=DIR the test writes the pictures of docs/ to
DIR.
"""

import json
import re

import pytest
from browser import DESKTOP, PHONE, SCREENSHOTS
from policy_file import copy_without_wiring
from robots import Fleet
from security import until
from serving import SHIPPED_POLICIES, page_of, running_server

ENERGY_MODEL = "int_sram_45nm"
WEAK_ROBOT = "arm-03"


def copy_policies(directory):
    """Copies shipped policies, two versions of each. Version 2 of cartpole will be rolled out; the others are idle or busy.

    Robots with broken motors look miswired, which is not what these tests are about.
    """
    for name in ("cartpole", "pendulum", "acrobot", "mountaincar"):
        for version in ("1", "2"):
            source = SHIPPED_POLICIES / name / version
            copy_without_wiring(source if source.exists() else source.with_name("1"), directory / name / version)
    return directory


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Starts a server and a fleet. Yields them."""
    policies = copy_policies(tmp_path_factory.mktemp("policies"))
    with running_server(policies) as addresses:
        addresses.admin.SetDefaultVersion(policy="cartpole", version=1)
        addresses.admin.SetLabel(policy="cartpole", version=1, label="stable")
        addresses.admin.SetShadow(policy="acrobot", shadow_version=1)
        addresses.admin.StartRollout(policy="cartpole", version=2, steps=[50, 100], min_episodes=20)
        robots = Fleet(addresses.agent)
        robots.add("CartPole-v1", "cartpole", 3, prefix="arm")
        robots.add("CartPole-v1", "cartpole", 1, broken={None: 0.5}, prefix="arm")  # arm-03
        # The motors of these robots ignore version 2, so its episodes end after about 20 steps whatever chance does. Those of
        # version 1 last 60, so that a busy machine plays the 20 that a roll-out compares.
        broken = {2: 1.0}
        robots.add("CartPole-v1", "cartpole", 8, broken, keeps_session=False, episode_steps=60, prefix="cart")
        robots.add("Pendulum-v1", "pendulum", 4, prefix="swing")
        with robots:
            yield addresses, robots


@pytest.fixture
def page(browser, fleet):
    """Opens the page at its first screen, as a new visitor, and waits until it shows traffic."""
    addresses, _ = fleet
    browser.resize(DESKTOP)
    browser.prefer("light")
    browser.open(f"http://{addresses.http}/")
    browser.wait_for("document.querySelectorAll('#policies-table tbody tr').length > 1", "policies")
    browser.wait_for("document.querySelector('#most-energy strong')", "energy")
    yield browser
    # The robot that is looked at may just have ended its episode: then there is no decision to explain yet.
    between_episodes = re.compile(r"/explain\.json\?session=\w+ .* status of 409")
    assert [each for each in browser.problems() if not between_episodes.search(each["message"])] == []


def document(fleet, path):
    return json.loads(page_of(fleet[0], path))


def test_which_policy_spends_most(page, fleet):
    said = page.text("#most-energy strong")
    assert said == page.records("policies-table")[0]["Policy"]
    versions = document(fleet, "/status.json?metrics=false")["versions"]
    most = max(versions, key=lambda version: version["energy_joules_per_second"].get(ENERGY_MODEL, 0.0))
    assert said == f"{most['policy']}/{most['version']}"
    assert page.evaluate("document.querySelector('#most-energy').getBoundingClientRect().bottom < innerHeight")


def test_whether_a_canary_is_worse(page):
    verdict = "document.querySelector('#comparisons .verdict.bad')?.textContent"
    said = page.wait_for(f"({verdict} ?? '').includes('worse return') && {verdict}", "a verdict")
    assert said.startswith("cartpole/2 has a worse return: ")
    # The server aborts the roll-out for the same reason, which is an alert.
    page.wait_for("document.querySelector('#comparisons h3').textContent.endsWith('aborted')", "the abort")
    page.wait_for("document.querySelector('#alerts .firing')", "the alert")
    assert "SpikeserveRolloutAborted" in page.text("#alerts")
    assert page.tiles()["Health"][::2] == ("not healthy", True)
    assert page.text("#health").startswith("not healthy: 1 alert firing")


def test_which_robot_has_the_lowest_return_and_what_its_last_decision_looked_like(page, fleet):
    lowest = """document.querySelector('#sessions-table tbody tr td:nth-child(2)')?.textContent"""
    page.evaluate("document.querySelector('#filter').scrollIntoView()")
    page.driver.find_element("id", "filter").send_keys("arm-")
    button = "[...document.querySelectorAll('#orders button')].find((e) => e.textContent === 'Lowest return')"
    page.driver.execute_script(f"{button}.click()")
    page.wait_for(f"{lowest} === 'robot={WEAK_ROBOT}'", "the weak robot in the first row")
    returns = [row["Mean return"] for row in page.records("sessions-table")]
    known = [float(text) for text in returns if text != "–"]
    assert known == sorted(known)

    page.click("#sessions-table tbody tr:first-child a")
    page.wait_for("document.querySelectorAll('#decision canvas').length >= 12", "the decision")
    assert WEAK_ROBOT in page.text("#session-tiles")
    _, robots = fleet
    assert page.evaluate("location.hash") == f"#/sessions/{robots.session_of(WEAK_ROBOT)}"
    sentence = page.text("#decision .verdict")
    assert sentence.startswith("Action ")
    assert "spikes" in sentence
    captions = page.evaluate("[...document.querySelectorAll('#decision figcaption')].map((e) => e.textContent)")
    assert {"Observation", "Probabilities of the actions", "Spikes by stage"} <= set(captions)


def test_decisions_are_followed_and_played_again(page, fleet):
    addresses, robots = fleet
    page.driver.get(f"http://{addresses.http}/#/sessions/{robots.session_of('arm-00')}")
    page.wait_for("document.querySelector('#frame').max >= 2", "three decisions")
    page.click("#follow")
    count = int(page.evaluate("document.querySelector('#frame').max")) + 1
    page.driver.execute_script("""
        window.shown = [];
        const text = document.querySelector('#frame-text');
        new MutationObserver(() => shown.push(text.textContent)).observe(text, {childList: true});""")
    page.click("#play")
    page.wait_for(f"shown.length >= {count}", "every decision")
    page.wait_for("document.querySelector('#play').ariaPressed === 'false'", "the end of the play")
    shown = page.evaluate("shown")
    assert [text.partition(":")[0] for text in shown] == [f"{i + 1} of {count}" for i in range(count)]
    assert len({text.partition(":")[2] for text in shown}) == count


def test_links_lead_to_a_policy_and_a_session(page, fleet):
    addresses, robots = fleet
    page.driver.get(f"http://{addresses.http}/#/policies/pendulum/2")
    page.wait_for("document.querySelector('#scope').textContent.includes('pendulum/2')", "the policy")
    page.wait_for("document.querySelectorAll('#sessions-table tbody tr').length === 4", "its sessions")
    assert {row["Policy"] for row in page.records("sessions-table")} == {"pendulum/2"}
    assert {row["Policy"] for row in page.records("policies-table")} == {"pendulum/1", "pendulum/2"}
    assert "Head drift" in page.tiles()
    page.driver.get(f"http://{addresses.http}/#/sessions/{robots.session_of('arm-01')}")
    page.wait_for("document.querySelector('#session-tiles').textContent.includes('robot=arm-01')", "the session")
    page.driver.back()
    page.wait_for("!document.querySelector('#policies').hidden", "the policy again")
    page.driver.get(f"http://{addresses.http}/#/sessions/nobody")
    page.wait_for("document.querySelector('#session-error').textContent.includes('nobody')", "the error")
    page.problems()  # Chromium reports the expected HTTP status 404


def test_idle_versions_are_folded(page):
    shown = {row["Policy"] for row in page.records("policies-table")}
    assert "mountaincar/1" not in shown
    page.click("#idle")
    page.wait_for("document.querySelectorAll('#policies-table tbody tr').length === 8", "all versions")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_fits_a_phone(page, scheme):
    page.resize(PHONE)
    page.prefer(scheme)
    page.wait_for("document.documentElement.scrollWidth <= innerWidth", "no sideways scrolling")
    labels = page.evaluate("""[...document.querySelectorAll('#policies-table tbody tr:first-child td')]
        .map((cell) => getComputedStyle(cell, '::before').content)""")
    assert '"Energy per second"' in labels


def wait_for_figures(page):
    """Waits until the page has drawn figures in its present size and colours."""
    page.driver.execute_script("performance.clearResourceTimings()")
    page.wait_for("performance.getEntriesByType('resource').length > 8", "new figures")


@pytest.mark.skipif(not SCREENSHOTS, reason="writes pictures only on request")
def test_pictures(page, fleet):
    addresses, robots = fleet
    history = lambda: len(document(fleet, "/history.json?seconds=600")["seconds_ago"]) > 40
    until(history, seconds=240)  # three minutes of figures
    for scheme in ("light", "dark"):
        page.prefer(scheme)
        wait_for_figures(page)
        page.screenshot(f"status-{scheme}.png", height=1300)
    page.prefer("light")
    page.resize(PHONE)
    wait_for_figures(page)
    page.screenshot("status-phone.png", height=1500)
    page.resize(DESKTOP)
    page.driver.get(f"http://{addresses.http}/#/sessions/{robots.session_of(WEAK_ROBOT)}")
    page.wait_for("document.querySelector('#frame').max >= 5", "six decisions")
    page.screenshot("session-light.png")
    page.prefer("dark")
    wait_for_figures(page)
    page.screenshot("session-dark.png")
