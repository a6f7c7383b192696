"""The page of `make bench` has the arm64 instructions that were counted apart from it."""

import pathlib
import sys

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "loadtest" / "bench")]

import report  # noqa: E402


def test_the_page_has_the_counted_instructions():
    page = (ROOT / "docs/evidence/performance.md").read_text()
    assert report.arm64_section() in page
    assert "Not timed on real hardware" in page
