"""Every limit in docs/reference/limits.md names tests that exist."""

import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).parents[3]
ROWS = [line for line in (ROOT / "docs/reference/limits.md").read_text().splitlines() if line.startswith("| ")][2:]


def names_of(row):
    return re.findall(r"`(\w+)`", row.rsplit("|", 2)[1])


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_a_limit_has_a_test(row, defined):
    assert names_of(row)
    assert set(names_of(row)) <= defined
