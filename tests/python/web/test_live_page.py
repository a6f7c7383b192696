"""The page of a session moves with each decision, and draws what the answer says. Looks at the pixels in headless Chromium.

With SPIKESERVE_SCREENSHOTS=DIR the test writes the picture of README to DIR.
"""

import json
import math
import shutil

import pytest
from browser import SCREENSHOTS
from policy_file import read_policy, write_policy
from robots import Robot
from serving import SHIPPED_POLICIES, page_of, running_server, status_of

CART = [0.5, 0.0, 0.1, 0.0]
DOUBLE = "double-pendulum"  # the policy of another task with observations of this size
# Observations in which the task leans to the left, and to the right: policy, what the page calls it, left, right.
TASKS = [
    ("cartpole", "cart and pole", [-1.0, 0.0, -0.2, 0.0], [1.0, 0.0, 0.2, 0.0]),
    ("pendulum", "pendulum", [0.0, 1.0, 0.5], [0.0, -1.0, 0.5]),
    ("pendulum-delay", "pendulum", [0.0, 1.0, 0.5], [0.0, -1.0, 0.5]),
    ("acrobot", "acrobot", [0.0, -1.0, 1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
    ("mountaincar", "car on a hill", [-1.0, 0.0], [0.4, 0.0]),
    ("lunar-lander", "lander", [-0.5, 1.0, 0, 0, 0, 0, 0, 0], [0.5, 1.0, 0, 0, 0, 0, 0, 0]),
    (DOUBLE, "cart with two poles", [-0.5, -0.5, 0, 0.8, 1, *[0] * 6], [0.5, 0.5, 0, 0.8, 1, *[0] * 6]),
]
UNKNOWN = "hopper"
# The mean x of the pixels in the colour of what moves, in widths of the canvas, and a hash of all pixels.
PIXELS = """(() => {
  const canvas = document.querySelector('#scene canvas');
  const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const spike = getComputedStyle(document.documentElement).getPropertyValue('--spike').trim();
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(spike.slice(i, i + 2), 16));
  let [sum, n, hash] = [0, 0, 0];
  for (let i = 0; i < data.length; i += 4) {
    hash = (hash * 31 + data[i] + 256 * data[i + 1] + 65536 * data[i + 2]) % 4294967291;
    if (data[i] !== r || data[i + 1] !== g || data[i + 2] !== b) continue;
    sum += i / 4 % canvas.width;
    n += 1;
  }
  return [sum / n / canvas.width, hash];
})()"""
# For each raster: its heading, its label, and the rows of the painted pixels in the middle of each column of cells.
RASTERS = """[...document.querySelectorAll('#decision .rasters canvas')].map((canvas) => {
  const heading = canvas.closest('.rasters').parentElement.querySelector('h3').textContent;
  const label = canvas.ariaLabel;
  const tokens = label.split(' ticks of ')[1].split(', ');
  const ticks = Number(/over ([0-9]+) ticks/.exec(label)[1]);
  const {width, height} = canvas;
  const {data} = canvas.getContext('2d').getImageData(0, 0, width, height);
  const style = getComputedStyle(document.documentElement);
  const ground = style.getPropertyValue('--ground').trim();
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(ground.slice(i, i + 2), 16));
  const columns = Array.from({length: tokens.length * ticks}, (_, column) => {
    const x = Math.floor((column + 0.5) * width / (tokens.length * ticks));
    const rows = [];
    for (let y = 0; y < height; ++y) {
      const i = 4 * (y * width + x);
      if (data[i] !== r || data[i + 1] !== g || data[i + 2] !== b) rows.push(y);
    }
    return rows;
  });
  return {heading, label, ticks, height, columns};
})"""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    policies = tmp_path_factory.mktemp("policies")
    tensors, metadata = read_policy(SHIPPED_POLICIES / "hopper/1/policy.safetensors")
    double = metadata | {"environment": "InvertedDoublePendulum-v4"}
    write_policy(policies / DOUBLE / "1/policy.safetensors", tensors, double)
    for name in [*(task[0] for task in TASKS if task[0] != DOUBLE), UNKNOWN, "cartpole-small"]:
        shutil.copytree(SHIPPED_POLICIES / name / "1", policies / name / "1")
    with running_server(policies) as addresses:
        yield addresses


def open_page(browser, server, policy, **options):
    """Opens a session and its page. Returns a function that makes a decision, and waits until the page draws it."""
    session = server.agent.OpenSession(policy=policy, **options).session_id
    step = 0
    browser.driver.get("about:blank")

    def act(observation):
        nonlocal step
        server.agent.Act(session_id=session, step=step, observation=observation)
        if step == 0:
            browser.driver.get(f"http://{server.http}/#/sessions/{session}")
        drawn = f"document.querySelector('#scene .quiet')?.textContent.startsWith('Episode 0, step {step},')"
        browser.wait_for(drawn, f"decision {step}")
        step += 1
        return session

    return act


def observation_size(server, name):
    policies = status_of(server, "?metrics=false")["policies"]
    return next(int(policy["observation_size"]) for policy in policies if policy["name"] == name)


@pytest.mark.parametrize(("policy", "what", "left", "right"), TASKS, ids=[task[0] for task in TASKS])
def test_the_task_moves_as_its_observation_does(browser, server, policy, what, left, right):
    act = open_page(browser, server, policy)
    act(left)
    at_left, first = browser.evaluate(PIXELS)
    act(right)
    at_right, second = browser.evaluate(PIXELS)
    assert at_left < 0.5 < at_right
    assert first != second
    assert browser.text("#scene figcaption").endswith(f": {what}")


def test_the_cart_is_where_the_observation_says(browser, server):
    act = open_page(browser, server, "cartpole")
    act([1.2, 0.0, 0.0, 0.0])  # half the way from the middle to the end, which is at 2.4
    at_half, _ = browser.evaluate(PIXELS)
    act([0.0, 0.0, 0.0, 0.0])
    in_the_middle, _ = browser.evaluate(PIXELS)
    assert in_the_middle == pytest.approx(0.5, abs=0.005)
    assert at_half == pytest.approx(0.5 + 1.2 * 138 / 720, abs=0.005)


def test_a_task_that_the_page_does_not_know_is_drawn_as_traces(browser, server):
    size = observation_size(server, UNKNOWN)
    act = open_page(browser, server, UNKNOWN)
    act([0.0] * size)
    act([1.0] + [0.0] * (size - 1))
    _, before = browser.evaluate(PIXELS)
    act([0.0] * size)
    assert browser.evaluate(PIXELS)[1] != before
    assert f": traces of {size} elements" in browser.text("#scene figcaption")


def expected_rasters(explained):
    """Returns the spikes by layer and stage: {(heading, stage): [rasters]}."""
    rasters = {}
    for raster in explained["rasters"]:
        heading = f"Spikes of layer {raster['layer']}" if "layer" in raster else "Spikes outside the layers"
        rasters.setdefault((heading, raster["stage"]), []).append(raster)
    return rasters


@pytest.mark.parametrize("policy", ["cartpole", "cartpole-small"])
def test_the_rasters_hold_the_spikes_of_the_answer_and_no_others(browser, server, policy):
    act = open_page(browser, server, policy)
    for _ in range(4):
        session = act(CART)
    browser.wait_for("document.querySelector('#frame-text').textContent.endsWith('step 3')", "the explanation")
    explained = json.loads(page_of(server, f"/explain.json?session={session}"))
    expected = expected_rasters(explained)
    spikes = 0
    for drawn in browser.evaluate(RASTERS):
        stage, _, rest = drawn["label"].partition(": ")
        rasters = expected.pop((drawn["heading"], stage))
        count = sum(len(raster["ticks"]) for raster in rasters)
        assert int(rest.split()[0]) == count
        spikes += count
        population = rasters[0]["population"]
        cell = drawn["height"] / population
        high = max(cell - 2, 4)
        wanted = [[] for _ in drawn["columns"]]
        for i, raster in enumerate(rasters):
            for tick, neuron in zip(raster["ticks"], raster["neurons"], strict=True):
                wanted[i * drawn["ticks"] + tick].append(neuron)
        for painted, neurons in zip(drawn["columns"], wanted, strict=True):
            for neuron in neurons:
                assert math.floor(neuron * cell + high / 2) in painted or neuron * cell + high / 2 > drawn["height"]
            allowed = {y for n in neurons for y in range(math.floor(n * cell) - 1, math.ceil(n * cell + high) + 1)}
            assert allowed.issuperset(painted)
            if cell > 8:  # cells do not touch each other, so the runs of pixels are the spikes
                assert sum(y - 1 not in painted for y in painted) == len(neurons)
    assert not any(raster["ticks"] for rasters in expected.values() for raster in rasters)
    assert spikes == int(explained["answer"]["stats"]["spikes"])
    assert f" {spikes} spikes" in browser.text("#decision .verdict")


def test_even_attention_is_said_and_other_attention_drawn(browser, server):
    act = open_page(browser, server, "cartpole")
    for _ in range(3):
        act(CART)
    browser.wait_for("document.querySelectorAll('#decision figure[aria-label^=attention]').length === 2", "words")
    said = browser.text("#decision figure[aria-label^=attention] .even")
    assert said.startswith("Every head looks at all ")
    assert "equal ones would be" in said
    act = open_page(browser, server, "lunar-lander")
    for i in range(6):
        act([float(i % size == 0) for size in range(1, 1 + observation_size(server, "lunar-lander"))])
    browser.wait_for("document.querySelector('#decision canvas[aria-label^=attention]')", "the map")


def test_nothing_is_sent_to_a_page_that_does_not_follow(browser, server):
    act = open_page(browser, server, "cartpole")
    act(CART)
    browser.wait_for("document.querySelector('#live-state').textContent.startsWith('Live:')", "the stream")
    browser.click("#follow")
    since = browser.evaluate("performance.now()")
    later = f"performance.getEntriesByType('resource').filter(({{startTime}}) => startTime > {since})"
    browser.wait_for(f"{later}.length >= 4", "further figures")
    assert browser.evaluate(f"{later}.filter(({{name}}) => /watch|explain/.test(name)).length") == 0
    # The stream that was open ends up in the list when it has been closed.
    browser.wait_for("performance.getEntriesByType('resource').some(({name}) => name.includes('/watch?'))", "the end")


def test_an_unusual_element_stands_beside_its_range_in_training(browser, server):
    act = open_page(browser, server, "cartpole", labels={"robot": "arm-07"})
    act([0.0, 0.0, 40.0, 0.0])
    browser.wait_for("document.querySelector('#observation .bad')", "the unusual element")
    assert browser.text("#observation .bad") == "Element pole_angle: unlike anything in training."
    assert browser.evaluate("document.querySelectorAll('#observation .bar-row.unusual').length") == 1
    assert "arm-07" in browser.tiles("session-tiles")


@pytest.mark.skipif(not SCREENSHOTS, reason="writes the picture only on request")
def test_picture(browser, server):
    robot = Robot(server.agent, "Pendulum-v1", "pendulum", "swing-03", {}, True, 200, seed=5)
    for _ in range(6):
        robot.act()
    browser.driver.get(f"http://{server.http}/#/sessions/{robot.session}")
    for i in range(8):
        robot.act()
        browser.wait_for(f"document.querySelector('#frame-text').textContent.endsWith('step {6 + i}')", "a decision")
    browser.screenshot("playing.png", top="#decision-title", height=880)
