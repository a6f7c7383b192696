"""The pages of `make lab-beats` have its rows."""

import json
import pathlib

import beats_table

ROOT = pathlib.Path(__file__).parents[2]


def test_the_pages_have_the_rows_of_the_beats():
    rows = json.loads((ROOT / "lab/bench/beats.json").read_text())
    for path, text in beats_table.pages(ROOT, rows):
        assert path.read_text() == text, f"{path}: expected the rows of beats.json, as make lab-beats writes them"
