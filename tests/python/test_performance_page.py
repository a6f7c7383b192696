"""The page of `make bench` has the arm64 instructions that were counted apart from it, and the pages of `make
bench-beats` have its rows."""

import json
import pathlib
import sys

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "loadtest" / "bench")]

import beats_table  # noqa: E402
import report  # noqa: E402


def test_the_page_has_the_counted_instructions():
    page = (ROOT / "docs/evidence/performance.md").read_text()
    assert report.arm64_section() in page
    assert "Not timed on real hardware" in page


def test_the_pages_have_the_rows_of_the_beats():
    rows = json.loads((ROOT / "loadtest/bench/beats.json").read_text())
    for path, text in beats_table.pages(ROOT / "docs", rows):
        assert path.read_text() == text, f"{path}: expected the rows of beats.json, as make bench-beats writes them"
