"""The page and the figures of `spikereport`, which lab/report/plot.py makes from its files."""

import json
import math
import os
import pathlib
import re
import shutil
import subprocess
import sys

import pytest
import report_page
from PIL import Image, ImageChops

ROOT = pathlib.Path(__file__).parents[2]
PLOT = ROOT / "lab/report/plot.py"

COMMITTED = ROOT / "lab/evidence/report"
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
    command = [os.environ["SPIKEREPORT_PROGRAM"], "--smoke", "--seeds=1", tasks, f"--out={directory}"]
    finished = subprocess.run(command, check=True, capture_output=True, text=True)
    assert finished.stdout.splitlines()[-1].endswith(f": python lab/report/plot.py {directory}")
    drawn = plot(directory)
    assert (drawn.returncode, drawn.stderr) == (0, "")
    written = {directory / "report.md", *(directory / f"{name}.png" for name in FIGURES)}
    assert {pathlib.Path(line) for line in drawn.stdout.splitlines()} == written
    return directory


def run_of(mode, seed, mean_return, ticks=10, context=20):
    """Returns a run of CartPole-v1 as runs.json lists it, with what its result.json holds."""
    evaluation = {"mean_return": mean_return, "spikes_per_decision": 100.0, "spikes_per_window": 2000.0}
    name = f"CartPole-v1-{mode}-T{ticks}-N{context}-seed{seed}"
    gates = [[0.25, 0.75], [0.75, 0.25]] if mode in ("route", "full") else []
    return {
        **{"run": name, "task": "CartPole-v1", "mode": mode, "ticks": ticks, "context": context},
        **{"command": f"spiketrain train --out={name}", "losses": [[10, 0.5], [20, 0.25]], "evaluation": evaluation},
        **{"gates": gates, "seconds_per_decision": 0.001},
    }


def page_of(runs, figures=(), seeds=(1, 2)):
    """Returns the page of two seeds of every mode: pos returns 480 on average, every other mode 400."""
    spread = {1: 0.1, 2: -0.1}
    modes = [
        run_of(mode, seed, (480 if mode == "pos" else 400) + spread[seed]) for mode in report_page.MODES for seed in seeds
    ]
    settings = {"seeds": 2, "steps": 400, "expert_fraction": 0.5, "disturbed_fraction": 0.0, "iterations": 20, "batch": 4}
    settings |= {"hidden_size": 16, "ticks": 10, "context": 20, "episodes": 3}
    commands = ["spikereport --out=x", "python lab/report/plot.py x"]
    data = {"commands": commands, "settings": settings, "modes": modes, "sweeps": runs}
    return "\n\n".join(report_page.sections(data, figures))


def test_an_interval_is_students_over_seeds():
    mean, half_width = report_page.interval([1.0, 2.0, 3.0])
    assert mean == pytest.approx(2.0, abs=1e-12)
    assert half_width == pytest.approx(4.303 / math.sqrt(3), abs=1e-3)
    assert math.isinf(report_page.interval([1.0])[1])


def test_the_page_says_what_the_intervals_allow():
    page = page_of([])
    assert "| CartPole-v1 | pos | 480.0 ± 1.3 | 474.1 | 500.0 |" in page
    assert (
        "pos returns 80.0 ± 0.0 more than baseline (significant); route returns 0.0 ± 0.0 more than baseline"
        " (not significant)" in page
    )
    assert "spiketrain train --out=CartPole-v1-dense-T10-N20-seed2" in page
    assert "| CartPole-v1 | pos | 0.2500 ± 0.0000 | 0.63 |" in page
    assert "| CartPole-v1 | full | 100.0 ± 0.0 | 2000.0 ± 0.0 | 8000 | 1.000 | 12.1 |" in page
    assert "| CartPole-v1 | route | 0.250 | 0.750 | 0.500 |" in page
    assert "```\nspikereport --out=x\npython lab/report/plot.py x\n```" in page
    assert "Sweeps" not in page


def test_one_seed_has_no_interval():
    page = page_of([], seeds=[1])
    assert "| CartPole-v1 | pos | 480.1 (one seed) | 474.1 | 500.0 |" in page
    assert "pos returns 80.0 ± inf more than baseline (not significant)" in page


def test_sweeps_have_every_seed_of_each_shape():
    shapes = [(5, 20), (10, 100)]
    page = page_of([run_of("full", seed, 298 + 2 * seed, *shape) for shape in shapes for seed in (1, 2)])
    assert "| CartPole-v1 | 10 | 20 | 400.0 ± 1.3 | 100.0 ± 0.0 |" in page
    assert "| CartPole-v1 | 5 | 20 | 301.0 ± 12.7 | 100.0 ± 0.0 |" in page
    assert "| CartPole-v1 | 10 | 100 | 301.0 ± 12.7 | 100.0 ± 0.0 |" in page


def test_the_page_links_only_to_figures_with_data():
    page = page_of([], figures=["membrane"])
    assert re.findall(r"\]\((.*)\)", page) == ["membrane.png"]


def test_the_page_has_the_runs_of_every_task(report):
    page = (report / "report.md").read_text()
    for task in ("CartPole-v1", "Pendulum-v1"):
        for mode in report_page.MODES:
            assert re.search(rf"^\| {task} \| {mode} \| \S+ \(one seed\) \|", page, re.MULTILINE)
            assert f"--out={task}-{mode}-T4-N4-seed1" in page
    assert "| CartPole-v1 | 2 | 4 | " in page and "| CartPole-v1 | 4 | 2 | " in page


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
    shutil.copytree(report, changed, ignore=shutil.ignore_patterns("*.png", "*-seed*", "runs.json"))
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
        assert same_pixels(COMMITTED / name, tmp_path / name), f"{name}: run python lab/report/plot.py {COMMITTED}"


def same_pixels(a, b):
    with Image.open(a) as first, Image.open(b) as second:
        if first.size != second.size:
            return False
        return ImageChops.difference(first.convert("RGB"), second.convert("RGB")).getbbox() is None


def test_runs_without_results_are_refused(report, tmp_path):
    for name in ("figures.json", "runs.json"):
        shutil.copy(report / name, tmp_path)
    refused = plot(tmp_path)
    assert refused.returncode == 1
    assert re.fullmatch(r"report: expected the runs of runs\.json in .* \(FileNotFoundError: .*\)\n", refused.stderr)


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


def test_the_drawings_are_those_of_the_script(tmp_path):
    drawings = COMMITTED.parent / "drawings"
    subprocess.run([sys.executable, PLOT.parent / "drawings.py", tmp_path], check=True, capture_output=True)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in drawings.iterdir()}
    for path in tmp_path.iterdir():
        assert same_pixels(drawings / path.name, path), f"{path.name}: run python lab/report/drawings.py {drawings}"
