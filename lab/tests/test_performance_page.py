"""The pages of `make lab-beats` have its rows, and what `make lab-bench` writes leads somewhere."""

import json
import pathlib
import re

import beats_table

ROOT = pathlib.Path(__file__).parents[2]


def test_the_pages_have_the_rows_of_the_beats():
    rows = json.loads((ROOT / "lab/bench/beats.json").read_text())
    for path, text in beats_table.pages(ROOT, rows):
        assert path.read_text() == text, f"{path}: expected the rows of beats.json, as make lab-beats writes them"


def test_the_links_of_the_report_exist():
    links = re.findall(r"\]\(([^)#]+)", (ROOT / "lab/bench/report.py").read_text())
    assert links and all((ROOT / "lab/evidence" / link).is_file() for link in links), links
