"""The figures of `spiketrain report`, drawn by train/report/plot.py from its figures.json."""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys

import pytest
from PIL import Image, ImageChops

ROOT = pathlib.Path(__file__).parents[2]
PLOT = ROOT / "train/report/plot.py"
COMMITTED = ROOT / "docs/evidence/report"
FIGURES = {"gates", "losses", "membrane", "phase_spikes", "phases", "spikes_by_stage", "spikes_per_decision", "surrogates"}


def plot(report):
    return subprocess.run([sys.executable, PLOT, report], check=False, capture_output=True, text=True)


def linked_images(report):
    """The files of the images in report.md."""
    return set(re.findall(r"^!\[[^]]+]\((.+)\)$", (report / "report.md").read_text(), re.MULTILINE))


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The directory of a small report with its figures."""
    directory = tmp_path_factory.mktemp("report")
    tasks = "--environments=CartPole-v1,Pendulum-v1"
    command = [os.environ["SPIKETRAIN_PROGRAM"], "report", "--smoke", "--seeds=1", tasks, f"--out={directory}"]
    finished = subprocess.run(command, check=True, capture_output=True, text=True)
    assert finished.stdout.splitlines()[-1] == f"Draw the figures with: python train/report/plot.py {directory}"
    drawn = plot(directory)
    assert (drawn.returncode, drawn.stderr) == (0, "")
    assert {pathlib.Path(line) for line in drawn.stdout.splitlines()} == {directory / f"{name}.png" for name in FIGURES}
    return directory


def test_every_figure_is_an_image_with_a_drawing(report):
    files = {f"{name}.png" for name in FIGURES}
    assert linked_images(report) == files
    for name in files:
        with Image.open(report / name) as image:
            image.verify()
        with Image.open(report / name) as image:
            assert min(image.size) > 200, name
            colours = image.convert("RGB").getcolors(image.width * image.height)
        white = max(count for count, _ in colours)
        assert len(colours) > 10, name
        assert white < 0.99 * sum(count for count, _ in colours), name


def test_a_figure_shows_its_data(report, tmp_path):
    """Other data give another image, in the figure of that data alone."""
    changed = tmp_path / "changed"
    shutil.copytree(report, changed, ignore=shutil.ignore_patterns("*.png", "*-seed*"))
    path = changed / "figures.json"
    figures = json.loads(path.read_text())
    figures["losses"]["CartPole-v1"]["modes"]["full"][0][0][1] += 1.0
    figures["gates"]["Pendulum-v1"]["route"][0][0] += 0.5
    path.write_text(json.dumps(figures))
    assert plot(changed).returncode == 0
    different = {name for name in FIGURES if not same_pixels(report / f"{name}.png", changed / f"{name}.png")}
    assert different == {"gates", "losses"}


def test_the_committed_figures_are_those_of_the_committed_data(tmp_path):
    shutil.copy(COMMITTED / "figures.json", tmp_path)
    assert plot(tmp_path).returncode == 0
    drawn = {path.name for path in tmp_path.glob("*.png")}
    assert {path.name for path in COMMITTED.glob("*.png")} == linked_images(COMMITTED) == drawn
    for name in drawn:
        assert same_pixels(COMMITTED / name, tmp_path / name), f"{name}: run python train/report/plot.py {COMMITTED}"


def same_pixels(a, b):
    with Image.open(a) as first, Image.open(b) as second:
        if first.size != second.size:
            return False
        return ImageChops.difference(first.convert("RGB"), second.convert("RGB")).getbbox() is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"report: expected a directory with figures\.json, received .*"),
        ('{"losses": ', r"report: expected JSON in .*figures\.json, received invalid text \(.*\)"),
        ("{}", r"report: expected an object of figures in .*figures\.json, received \{\}"),
        ('{"loses": {}}', r"report: expected the figures losses, .* in .*figures\.json, received 'loses'"),
        ('{"membrane": {"threshold": 1}}', r"report: expected the data of membrane .* \(KeyError: 'potentials'\)"),
        ('{"losses": {"x": {"unit": "u", "modes": {"full": 3}}}}', r"report: expected the data of losses .*"),
    ],
)
def test_other_data_are_refused_in_one_line(tmp_path, text, message):
    if text is not None:
        (tmp_path / "figures.json").write_text(text)
    refused = plot(tmp_path)
    assert refused.returncode == 1
    assert refused.stdout == ""
    assert re.fullmatch(message + "\n", refused.stderr)
    assert not list(tmp_path.glob("*.png"))
