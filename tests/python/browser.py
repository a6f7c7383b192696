"""Controls a headless Chromium. With SPIKESERVE_SCREENSHOTS=DIR it writes pictures for docs/ to DIR."""

import base64
import contextlib
import os
import pathlib

import pytest
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.wait import WebDriverWait
from serving import DEADLINE_SECONDS

SCREENSHOTS = os.environ.get("SPIKESERVE_SCREENSHOTS")
DESKTOP = (1280, 900)
PHONE = (390, 844)
# The browser, the server and the robots share a machine that may run other tests.
WAIT_SECONDS = 4 * DEADLINE_SECONDS


class Browser:
    """A headless Chromium that a test controls with the keyboard and the mouse."""

    def __init__(self, driver):
        self.driver = driver

    def open(self, address):
        """Opens a page anew, and forgets the problems of the page before."""
        self.driver.get("about:blank")
        self.problems()
        self.driver.get(address)

    def wait_for(self, script, what):
        """Waits until the result of a script is true, and returns it."""
        wait = WebDriverWait(self.driver, WAIT_SECONDS, poll_frequency=0.1)
        return wait.until(lambda driver: driver.execute_script(f"return {script}"), what)

    def evaluate(self, script):
        return self.driver.execute_script(f"return {script}")

    def text(self, selector):
        return self._with(selector, lambda element: element.text)

    def click(self, selector):
        self._with(selector, lambda element: element.click())

    def _with(self, selector, use):
        """Uses an element. Finds it again if the page has drawn it anew in the meantime, as a live page does all the time."""
        while True:
            try:
                return use(self.driver.find_element(By.CSS_SELECTOR, selector))
            except StaleElementReferenceException:
                continue

    def rows(self, table):
        """Returns the texts of the cells of a table, by row."""
        return self.evaluate(f"""[...document.querySelectorAll('#{table} tbody tr')]
            .map((row) => [...row.cells].map((cell) => cell.textContent))""")

    def records(self, table):
        """Returns the rows of a table as dicts from the heading of the column to the text."""
        heads = self.evaluate(
            f"[...document.querySelectorAll('#{table} thead th')].map((cell) => cell.textContent)"
        )
        return [dict(zip(heads, row, strict=True)) for row in self.rows(table)]

    def tiles(self, grid="tiles"):
        """Returns the tiles by label: (value, note, whether the tile is red)."""
        found = self.evaluate(f"""[...document.querySelectorAll('#{grid} > div')].map((tile) =>
            [...[...tile.children].slice(0, 3).map((part) => part.textContent), tile.classList.contains('alarm')])""")
        return {label: (value, note, red) for label, value, note, red in found}

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

    def resize(self, size):
        """Sets the size of the window in CSS pixels; at the size of a phone, also its density."""
        width, height = size
        metrics = {"width": width, "height": height, "deviceScaleFactor": 2 if size == PHONE else 1}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics | {"mobile": size == PHONE})

    def problems(self):
        return [entry for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]

    def screenshot(self, name, height=None, scale=1.0, top="html"):
        """Writes a picture of the page, from the top of an element. `height` limits its height in CSS pixels."""
        if not SCREENSHOTS:
            return
        clip = self.evaluate("{x: 0, y: 0, width: innerWidth, height: document.documentElement.scrollHeight}")
        clip["y"] = self.evaluate(f"document.querySelector('{top}').getBoundingClientRect().top + scrollY")
        clip["height"] -= clip["y"]
        clip["height"] = min(clip["height"], height or clip["height"])
        parameters = {"format": "png", "clip": clip | {"scale": scale}, "captureBeyondViewport": True}
        picture = self.driver.execute_cdp_cmd("Page.captureScreenshot", parameters)["data"]
        path = pathlib.Path(SCREENSHOTS) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(picture))


@contextlib.contextmanager
def chromium():
    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    # The sandbox of Chromium does not start as root in a container, where the tests may run.
    size = "window-size={},{}".format(*DESKTOP)
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "hide-scrollbars", size):
        options.add_argument(f"--{argument}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService("/usr/bin/chromedriver")
    driver = webdriver.Chrome(options=options, service=service)
    try:
        browser = Browser(driver)
        browser.resize(DESKTOP)
        yield browser
    finally:
        driver.quit()
