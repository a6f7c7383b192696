"""What the status page says to somebody who watches fifty robots, of which one has a broken sensor."""

import json
import shutil
import threading

import pytest
from browser import DESKTOP, PHONE
from serving import SHIPPED_POLICIES, running_server

ROBOTS = 50
BROKEN = "arm-17"
GOOD = [0.01, -0.02, 0.03, 0.1]
FAR = [0.01, -0.02, 40.0, 0.1]  # no pole of the training data leaned like this
VERSION_2 = {f"arm-{i}" for i in range(10, 20)}  # they ask for it; the traffic is not split


class Fleet:
    """Robots that act in turn, on a thread, until the end of the block. Two tasks, two versions, one broken sensor."""

    def __init__(self, service):
        self._service = service
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._play)
        self.sessions = {}

    def __enter__(self):
        for i in range(ROBOTS):
            name = f"arm-{i:02}"
            version = 2 if name in VERSION_2 else 1
            self.sessions[name] = self._open("cartpole", name, version=version)
        self._swing = self._open("pendulum", "swing-00")
        for session, observation in ((self.sessions["arm-00"], GOOD), (self._swing, [1.0, 0.0, 0.0])):
            self._service.Act(session_id=session, step=0, observation=observation)
            self._service.EndEpisode(session_id=session, reward=1.0, terminated=True)
        self._thread.start()
        return self

    def _open(self, policy, name, **more):
        return self._service.OpenSession(policy=policy, labels={"robot": name}, **more).session_id

    def _play(self):
        step = 0
        while not self._stop.wait(0.5):
            for name, session in self.sessions.items():
                observation = FAR if name == BROKEN else GOOD
                self._service.Act(session_id=session, step=step, observation=observation, reward=1.0)
            step += 1

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    policies = tmp_path_factory.mktemp("policies")
    for name in ("cartpole", "pendulum"):
        for version in ("1", "2") if name == "cartpole" else ("1",):
            shutil.copytree(SHIPPED_POLICIES / name / version, policies / name / version)
    with running_server(policies) as addresses, Fleet(addresses.agent) as robots:
        yield addresses.http, robots


@pytest.fixture
def page(browser, fleet):
    """Opens the page and waits until the alert on unusual observations names a robot."""
    address, _ = fleet
    browser.resize(DESKTOP)
    browser.open(f"http://{address}/")
    browser.wait_for("document.querySelector('#alerts .robots a')", "the robot in the alert")
    yield browser
    assert browser.problems() == []


def test_the_alert_names_the_robot_and_leads_to_its_element(page, fleet):
    _, robots = fleet
    [alert] = page.evaluate("""[...document.querySelectorAll('#alerts li')].map((e) => e.textContent)
        .filter((text) => text.startsWith('SpikeserveUnusualObservations'))""")
    assert f"robot {BROKEN}" in alert
    page.click("#alerts .robots a")
    page.wait_for("document.querySelector('#observation .bar-row.unusual')", "the element")
    assert page.evaluate("location.hash") == f"#/sessions/{robots.sessions[BROKEN]}"
    assert page.text("#observation .bad") == "Element pole_angle: unlike anything in training."


def test_robots_are_listed_by_their_label(page):
    page.wait_for("document.querySelectorAll('#sessions-table tbody tr').length === 50", "a page of robots")
    names = [row["Robot"] for row in page.records("sessions-table")]
    assert all(name.startswith(("arm-", "swing-")) for name in names)
    button = "[...document.querySelectorAll('#orders button')].find((e) => e.textContent === 'Unusual observations')"
    page.driver.execute_script(f"{button}.click()")
    first = "document.querySelector('#sessions-table tbody td')?.textContent"
    page.wait_for(f"{first} === {json.dumps(BROKEN)}", "the broken robot in the first row")


def test_the_list_names_the_robot_whatever_its_share_is(page):
    page.wait_for(f"document.querySelector('#unusual').textContent.endsWith(': {BROKEN}')", "the robot")
    assert page.evaluate("document.querySelector('#unusual a').hash").startswith("#/sessions/")


def test_one_line_says_whether_all_is_well_in_the_words_of_the_banners(page):
    # Read at once, because a busy machine raises further alerts. An alert has a banner for each instance.
    said, word, alerts, firing, pending = page.evaluate("""(() => {
      const names = (state) => new Set([...document.querySelectorAll(`#alerts .${state} strong`)].map((e) => e.textContent));
      const tile = [...document.querySelectorAll('#tiles > div')].find((e) => e.firstChild.textContent === 'Health');
      const firing = names('firing');
      return [document.querySelector('#health').textContent, tile.children[1].textContent, tile.children[2].textContent,
              firing.size, [...names('pending')].filter((name) => !firing.has(name)).length];
    })()""")
    assert said == f"{word}: {alerts}"
    assert word == ("not healthy" if firing else "healthy")
    parts = [f"{firing} alert{'s' if firing > 1 else ''} firing"] * (firing > 0) + [f"{pending} pending"] * (pending > 0)
    assert alerts == ", ".join(parts)


# Writes the widest text that the tile of the server's health can have, and returns the texts that are cut off.
CUT_OFF = """(() => {
  document.querySelector('#tiles dd.value').textContent = 'not healthy';
  return [...document.querySelectorAll('#tiles :is(dt, dd)')].filter((e) => e.scrollWidth > e.clientWidth).map((e) => e.textContent);
})()"""


@pytest.mark.parametrize("size", [DESKTOP, (1130, 800), PHONE])
def test_no_tile_cuts_off_what_it_says(page, size):
    page.resize(size)
    assert page.evaluate(CUT_OFF) == []


def test_returns_of_different_tasks_are_not_averaged(page):
    page.driver.execute_script("const e = document.querySelector('#window'); e.value = '1000000000';"
                               "e.dispatchEvent(new Event('change'));")
    note = "[...document.querySelectorAll('#tiles > div')].map((e) => e.textContent).find((text) => text.startsWith('Episode return'))"
    page.wait_for(f"{note}.includes('their tasks differ')", "no average")
    assert page.tiles()["Episode return"][0] == "–"


def test_versions_that_play_are_compared_without_a_split(page):
    title = "document.querySelector('#comparisons h3')?.textContent"
    page.wait_for(f"{title} === 'Versions of cartpole'", "the comparison")
    names = page.evaluate("[...document.querySelectorAll('#comparisons tbody td:first-child')].map((e) => e.textContent)")
    assert names == ["cartpole/1", "cartpole/2"]


def test_banners_are_folded_on_a_phone(page, fleet):
    address, _ = fleet
    page.resize(PHONE)
    page.driver.get("about:blank")
    page.driver.get(f"http://{address}/")
    page.wait_for("document.querySelector('#alerts .robots a')", "the robot in the alert")
    assert page.evaluate("[...document.querySelectorAll('#alerts details')].every((e) => !e.open)")
    assert page.evaluate("document.querySelector('#alerts .robots a').getBoundingClientRect().height > 0")
    page.click("#alerts summary strong")
    page.wait_for("document.querySelector('#alerts details').open", "the description")


# Draws a line over 100 s with values at both ends, and `missing` seconds without in the middle. Returns how many columns of
# pixels between the ends are empty.
EMPTY_COLUMNS = """import('./charts.js').then(({makeChart}) => {
  const box = document.createElement('div');
  document.body.append(box);
  const plot = makeChart(box, 'test', [{label: 'line', colour: '#0072b2'}], String, String, (_, a, b) => [a, b], [10], 30);
  const times = Array.from({length: 101}, (_, i) => i);
  plot.setData([times, times.map((t) => (Math.abs(t - 50) < MISSING / 2 ? null : 5))]);
  return new Promise((resolve) => setTimeout(resolve)).then(() => {
    const {width, height} = plot.ctx.canvas;
    const {data} = plot.ctx.getImageData(0, 0, width, height);
    let empty = 0;
    for (let x = plot.bbox.left + 8; x < plot.bbox.left + plot.bbox.width - 8; ++x) {
      let painted = false;
      for (let y = 0; y < height; ++y) {
        const i = 4 * (Math.round(x) + y * width);
        painted ||= data[i] === 0x00 && data[i + 1] === 0x72 && data[i + 2] === 0xb2;
      }
      empty += !painted;
    }
    box.remove();
    return empty / plot.bbox.width;
  });
})"""


def test_gaps_are_drawn_as_gaps_and_pauses_between_episodes_are_not(page):
    assert page.evaluate(EMPTY_COLUMNS.replace("MISSING", "20")) == 0
    assert 0.3 < page.evaluate(EMPTY_COLUMNS.replace("MISSING", "40")) < 0.5
    path = page.evaluate("""import('./tiles.js').then(({drawSparkline}) => {
      const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
      svg.append(document.createElementNS('http://www.w3.org/2000/svg', 'path'));
      drawSparkline(svg, [1, 2, null, 3, ...Array(10).fill(null), 4, 5]);
      return svg.firstChild.getAttribute('d');
    })""")
    assert [step for step in path if step.isalpha()] == ["M", "L", "L", "M", "L"]
