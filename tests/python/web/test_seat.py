"""Operators steer sessions on the status page, with the keyboard and a gamepad, in headless Chromium."""

import pytest
from security import OBSERVATION, until
from selenium.webdriver.common.keys import Keys
from serving import series

GAMEPAD = """window.pad = {index: 0, axes: [0, 0, 0, 0], buttons: Array.from({length: 16}, () => ({pressed: false}))};
navigator.getGamepads = () => [window.pad, null];"""
CLOCK = """const now = performance.now.bind(performance), send = window.fetch;
window.later = 0, window.renewals = 0;
performance.now = () => now() + later;
window.fetch = (path, ...rest) => { if (`${path}`.includes('steer.json')) renewals += 1; return send(path, ...rest); };"""
SEAT = "document.querySelector('#seat-state').textContent"
AGREEMENT = "document.querySelector('#seat-agreement').textContent"
BUTTON = "document.querySelector('#seat-button').textContent"


class Steered:
    """A session whose page is open, and its robot."""

    def __init__(self, browser, server, policy, observation):
        self.server, self.browser, self.observation, self.step = server, browser, observation, 0
        self.session = server.agent.OpenSession(policy=policy).session_id
        self.act()
        browser.open(f"http://{server.http}/#/sessions/{self.session}")
        browser.wait_for(f"{BUTTON} === 'Take control'", "the seat")

    def act(self):
        answer = self.server.agent.Act(
            session_id=self.session, step=self.step, observation=self.observation, reward=1.0
        )
        self.step += 1
        return answer

    def until_acts(self, operator, wanted=lambda action: True):
        """Makes decisions until `operator` chooses one that is wanted; empty: the policy."""

        def is_heard():
            answer = self.act()
            return answer.source.operator_id == operator and wanted(answer.action)

        until(is_heard)

    def take(self, name):
        """Takes control by the keyboard alone."""
        self.browser.driver.execute_script("document.querySelector('#seat-name').value = ''")
        self.browser.tab_to("e.id === 'seat-name'")
        self.browser.press(name)
        self.browser.tab_to("e.id === 'seat-button'")
        self.browser.press(Keys.ENTER)


def test_an_operator_steers_with_keys_and_is_relieved(browser, server):
    robot = Steered(browser, server, "cartpole", OBSERVATION)
    robot.take("ann")
    browser.wait_for(f"{SEAT} === 'ann, you have control.'", "control")
    for key, action in (("1", 1), ("0", 0), ("1", 1)):
        browser.press(key)
        robot.until_acts("ann", lambda taken, action=action: taken.discrete == action)
        assert browser.text("#seat-actions [aria-pressed=true]") == f"action {action}"
    browser.wait_for(f"/^The policy agreed in [0-9]+ of [1-9][0-9]* steps/.test({AGREEMENT})", "the agreement")
    server.admin.HoldSessions(id="fire", reason="smoke", selection={"session_ids": [robot.session]})
    robot.act()
    browser.wait_for(f"{AGREEMENT} === 'Held by fire: smoke. You are not heard.'", "the hold")
    server.admin.ResumeSessions(id="fire")
    browser.press("0")
    robot.until_acts("ann")
    other = server.admin.TakeControl(session_id=robot.session, operator_id="bob", lease_seconds=60, take_over=True)
    assert other.relieved_operator_id == "ann"
    lost = "document.querySelector('#seat-error').textContent"
    browser.wait_for(f"{lost}.startsWith('You no longer have control.') && {lost}.includes('\"bob\"')", "the loss")
    browser.wait_for(f"{BUTTON} === 'Take over from bob'", "who has control")
    robot.take("ann")
    browser.wait_for(f"{SEAT} === 'ann, you have control; bob is relieved.'", "control again")
    robot.until_acts("ann")
    browser.press("q")
    browser.wait_for(f"{SEAT} === 'You returned the session to its policy.'", "the return")
    robot.until_acts("")
    # Chromium reports the expected HTTP status 409 in its console.
    assert all("409" in entry["message"] for entry in browser.problems())


def test_any_key_shows_that_the_operator_is_there(browser, server):
    robot = Steered(browser, server, "cartpole", OBSERVATION)
    browser.driver.execute_script(CLOCK)
    robot.take("ann")
    browser.wait_for(f"{SEAT} === 'ann, you have control.'", "control")
    for seconds in (25, 50):
        browser.driver.execute_script(f"later = {1000 * seconds}")
        browser.press("x")  # has no meaning
        browser.driver.execute_script("renewals = 0")
        browser.wait_for("renewals > 1", "a lease that goes on")
    browser.driver.execute_script("later = 100_000")
    browser.wait_for(f"{SEAT} === 'You did nothing for 30 s, so the policy acts again.'", "the end of the lease")
    robot.until_acts("")
    assert browser.problems() == []


def test_a_gamepad_steers_a_box_while_the_page_has_the_focus(browser, server):
    robot = Steered(browser, server, "pendulum", [1.0, 0.0, 0.5])
    browser.driver.execute_script(GAMEPAD)
    robot.take("ann")
    browser.wait_for(f"{SEAT} === 'ann, you have control.'", "control")
    browser.press("d")  # a tenth of the range from -2 to 2
    robot.until_acts("ann", lambda taken: taken.continuous.values[0] == pytest.approx(0.4))
    for x, torque in ((0.5, 1.0), (-1.0, -2.0), (0.05, 0.0)):
        browser.driver.execute_script(f"pad.axes[0] = {x}")
        robot.until_acts("ann", lambda taken, torque=torque: taken.continuous.values[0] == pytest.approx(torque))
    # A stick that lies still leaves the slider alone.
    browser.driver.execute_script(
        "const e = document.querySelector('#seat-actions input'); e.value = 1.5; e.dispatchEvent(new Event('input'))"
    )
    robot.until_acts("ann", lambda taken: taken.continuous.values[0] == pytest.approx(1.5))
    page = browser.driver.current_window_handle
    browser.driver.switch_to.new_window("tab")
    robot.until_acts("")
    browser.driver.close()
    browser.driver.switch_to.window(page)
    browser.wait_for(f"/^The page (was hidden|lost the focus), so the policy acts again.$/.test({SEAT})", "the reason")
    # The page has returned it at once, instead of letting the lease end.
    changes = {
        change: series(server, "spikeserve_seat_changes_total", policy="pendulum", change=change)
        for change in ("returned", "ended")
    }
    assert changes == {"returned": [1], "ended": [0]}
    assert browser.evaluate("document.querySelector('#seat-actions').hidden")
    assert browser.problems() == []


@pytest.mark.parametrize("scope", ["SESSION", "FLEET"])
def test_what_an_operator_taught_is_undone_by_two_presses(browser, server, scope):
    opened = server.agent.OpenSession(policy="cartpole", learning={"rule": "corrections", "scope": scope})
    robot = {"session_id": opened.session_id}
    answer = server.agent.Act(step=0, observation=OBSERVATION, **robot)
    server.admin.TakeControl(
        operator_id="ann", lease_seconds=60, action={"discrete": 1 - answer.action.discrete}, **robot
    )
    for step in range(1, 4):
        server.agent.Act(step=step, observation=OBSERVATION, reward=1.0, **robot)
    if scope == "FLEET":
        server.agent.EndEpisode(reward=1.0, terminated=True, **robot)
        server.agent.Act(step=0, observation=OBSERVATION, **robot)
    drift = lambda: server.agent.GetSession(**robot).head_drift
    taught = drift()
    assert taught > 0.0
    browser.open(f"http://{server.http}/#/sessions/{opened.session_id}")
    browser.wait_for("document.querySelector('#undo-name').value === 'ann'", "the operator")
    button = "document.querySelector('#undo-button').textContent"
    browser.tab_to("e.id === 'undo-button'")
    browser.press(Keys.ENTER)
    browser.wait_for(f"{button} === 'Press again to undo'", "the question")
    assert browser.text("#undo-state") == ("Of the whole fleet." if scope == "FLEET" else "")
    browser.press(Keys.TAB)  # another place takes it back
    browser.wait_for(f"{button} === 'Undo'", "the answer no")
    assert drift() == taught
    browser.tab_to("e.id === 'undo-button'")
    browser.press(Keys.ENTER, Keys.ENTER)
    browser.wait_for(
        "/^[1-9][0-9]* updates undone/.test(document.querySelector('#undo-state').textContent)", "the undoing"
    )
    assert drift() == 0.0
    assert browser.problems() == []
