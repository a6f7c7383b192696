"""The engine in WebAssembly gives the golden answers, and the playground plays as the native engine does."""

import collections
import functools
import hashlib
import http.server
import json
import pathlib
import threading

import gymnasium
import pytest
from spikeserve_engine import Engine

from browser import SCREENSHOTS, chromium
from serving import SHIPPED_POLICIES, run

ROOT = pathlib.Path(__file__).parents[3]
WASM = ROOT / "build/wasm"
PAGE = WASM / "playground"
GOLDEN = ROOT / "tests/golden/answers.txt"

pytestmark = pytest.mark.skipif(not (PAGE / "spikeserve.wasm").exists(), reason="without the output of `make playground`")

PIXELS = """(() => {
  const canvas = document.querySelector('#scene canvas');
  const {data} = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  return data.reduce((hash, byte) => (hash * 31 + byte) % 4294967291, 0);
})()"""
# The newest episode that the page lists: seed, return, steps.
EPISODES = """[...document.querySelectorAll('#episodes tr')].map((row) => [...row.cells].map((cell) => cell.textContent))"""


def versions():
    files = sorted(SHIPPED_POLICIES.glob("*/*/policy.safetensors"))
    return {file: file.parent.relative_to(SHIPPED_POLICIES).as_posix() for file in files}


def test_golden_answers_with_and_without_simd():
    names = versions()
    # Emscripten would otherwise fetch its file, as in a browser.
    played = run("node", "--no-experimental-fetch", WASM / "bin/golden_play.js", *names).stdout
    hashes = collections.defaultdict(dict)
    for line in played.splitlines():
        file, kind, target, answers = line.split()
        digest = hashlib.sha256(bytes.fromhex(answers)).hexdigest()
        hashes[target][names.get(pathlib.Path(file), file), kind] = digest
    expected = {tuple(line.split()[:2]): line.split()[2] for line in GOLDEN.read_text().splitlines()}
    assert set(hashes) == {"WASM", "EMU128"}
    for target, received in hashes.items():
        assert received == expected, target


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def address():
    """Serves the page as any server of static files does."""
    handler = functools.partial(QuietHandler, directory=PAGE)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


def choose(browser, select, value):
    browser.driver.execute_script(
        f"const e = document.getElementById('{select}'); e.value = arguments[0]; e.dispatchEvent(new Event('change'))", value
    )


def play_natively(policy, seed):
    """Returns the return and the number of steps of an episode with the native engine and Gymnasium."""
    engine = Engine(SHIPPED_POLICIES / policy / "policy.safetensors")
    session = engine.session()
    environment = gymnasium.make(engine.environment)
    observation, _ = environment.reset(seed=seed)
    total = reward = 0.0
    for step in range(1, 1000):
        action = session.act(observation, reward).action
        observation, reward, terminated, truncated, _ = environment.step(action)
        total += reward
        if terminated or truncated:
            return total, step
    raise AssertionError("the episode does not end")


@pytest.mark.parametrize("policy", ["cartpole-small/1", "cartpole/2", "pendulum/1"])
def test_a_policy_plays_as_the_native_engine_does(browser, address, policy):
    browser.driver.get("about:blank")
    browser.driver.get(address)
    browser.wait_for("document.querySelector('#scene .quiet')?.textContent.startsWith('Episode 0, step ')", "a decision")
    choose(browser, "speed", "0")
    choose(browser, "seed", "11")
    choose(browser, "policy", policy)
    browser.wait_for("document.querySelectorAll('#episodes tr').length >= 2", "two episodes")
    listed = {int(row[0]): row for row in browser.evaluate(EPISODES)}
    for seed in (11, 12):
        total, steps = play_natively(policy, seed)
        assert listed[seed][1:3] == [f"{total:.3f}", str(steps)]
    assert browser.text("#error") == ""
    assert not browser.problems()


def test_steps_move_the_task_and_draw_their_spikes(browser, address):
    browser.driver.get("about:blank")
    browser.driver.get(address)
    browser.wait_for("document.querySelector('#scene .quiet')?.textContent.startsWith('Episode 0, step ')", "a decision")
    browser.click("#play")
    seen = set()
    for _ in range(5):
        browser.click("#step")
        seen.add(browser.evaluate(PIXELS))
        tiles = browser.tiles("session-tiles")
        spikes = int(tiles["Spikes"][0].replace(",", ""))
        assert f" {tiles['Spikes'][0]} spikes, {tiles['Energy'][0]} " in browser.text("#decision .verdict")
        drawn = browser.evaluate(
            "[...document.querySelectorAll('#decision .rasters figcaption')].map((caption) => caption.textContent)"
        )
        assert sum(int(caption.split(": ")[1].split()[0]) for caption in drawn) == spikes > 0
    assert len(seen) == 5
    if SCREENSHOTS:
        browser.screenshot("playground.png", height=880)


def test_a_file_that_cannot_be_played_is_named(browser, address):
    browser.driver.get("about:blank")
    browser.driver.get(address)
    browser.wait_for("document.querySelectorAll('#policy option').length", "the policies")
    browser.driver.execute_script("document.querySelector('#policy').add(new Option('none/1', 'none/1'))")
    choose(browser, "policy", "none/1")
    browser.wait_for("document.querySelector('#error').textContent.includes('404')", "the error")


def test_the_page_has_the_policies_that_it_lists():
    listed = json.loads((PAGE / "policies.json").read_text())
    assert len(listed) == len(set(listed)) >= 5
    for name in listed:
        file = f"{name}/policy.safetensors"
        assert (PAGE / "policies" / file).read_bytes() == (SHIPPED_POLICIES / file).read_bytes()
