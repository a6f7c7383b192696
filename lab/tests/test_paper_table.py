"""lab/evidence/paper.md has a row for each part of the paper, and what a row names exists."""

import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
PAGE = ROOT / "lab/evidence/paper.md"
TEXT = PAGE.read_text()
TABLE = TEXT.split("## Part by part")[1].split("\n## ")[0]
ROWS = [[cell.strip() for cell in line[2:-2].split(" | ")] for line in TABLE.splitlines() if line.startswith("| ")][2:]
FLAGS = (ROOT / "docs/reference/flags.md").read_text()
VERDICTS = ("holds", "does not hold", "cannot be told", "built", "not built")

# How the paper is divided: sections without subsections, and the tags of its equations.
SECTIONS = [
    *("1", "2.1", "2.2", "2.3", "2.4", "3.1.1", "3.1.2", "3.1.3", "3.1.4", "3.2", "4"),
    *("4.1.1", "4.1.2", "4.1.3", "4.1.4", "4.2.1", "4.2.2", "4.2.3", "4.2.4", "4.3.1", "4.3.2", "4.3.3", "4.3.4"),
    *("5", "5.1", "5.2", "5.3", "5.4", "6.1", "6.2", "6.3", "6.4", "7.1", "7.2", "7.3", "8"),
    *("9.1", "9.2", "9.3.1", "9.3.2", "9.4"),
]
EQUATIONS = [*"123456789", "10", "4.1", "4.2", "4.5", "4.6", "4.7", "4.8", "4.9", "4.10", "5.1"]
PARTS = {"claim": range(1, 10), "figure": range(1, 20), "table": range(1, 8), "algorithm": range(1, 3)}


def parts_of(cell):
    """Returns what a first cell names: sections and equations by their numbers, other parts as in "figure 3"."""
    found = {f"section {number}" for number in re.findall(r"^[\d.]+(?= )", cell)}
    for numbers in re.findall(r"eq\. ((?:[\d.]*\d)(?:(?:, | and )[\d.]*\d)*)", cell):
        found |= {f"eq. {number}" for number in re.findall(r"[\d.]*\d", numbers)}
    return found | set(re.findall(r"(?:claim|figure|table|algorithm) \d+", cell))


def named(cell):
    return re.findall(r"`([^`]+)`", cell)


def test_every_part_has_a_row():
    parts = {f"section {section}" for section in SECTIONS} | {f"eq. {equation}" for equation in EQUATIONS}
    parts |= {f"{kind} {number}" for kind, numbers in PARTS.items() for number in numbers}
    assert set().union(*(parts_of(row[0]) for row in ROWS)) == parts


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_row_is_complete(row, defined):
    part, here, test, verdict = row
    assert parts_of(part)
    assert here
    assert test == "none" or (named(test) and set(named(test)) <= defined)
    assert verdict.startswith(VERDICTS)
    assert not (here.startswith("none") and verdict.startswith(("built", "holds")))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_what_a_row_names_exists(row):
    here = row[1]
    texts = [(ROOT / "docs/design/learning.md").read_text(), (ROOT / "core/model/config.h").read_text()]
    texts.append((ROOT / "lab/past_policies.md").read_text())
    for link in re.findall(r"\]\(([^)#]+)", here):
        path = (PAGE.parent / link).resolve()
        assert path.is_file()
        if path.suffix != ".png":
            texts.append(path.read_text())
    for name in named(here):
        if name.startswith("--"):
            assert re.search(f"`{name.split('=')[0]}[=`]", FLAGS), name
        elif name == "spikereport":
            assert (ROOT / "lab/report/spikereport.cc").is_file()
        elif name.startswith("spike"):
            assert f"### {name}\n" in FLAGS, name
        else:
            assert any(re.search(rf"\b{name}\b", text) for text in texts), name


def test_the_first_words_have_the_verdict_of_every_claim():
    text = (ROOT / "docs/evidence/paper.md").read_text()
    assert re.findall(r"\((\d)\)", " ".join(text.split()[:200])) == [*"123456789"]


def test_the_tables_in_per_cent_are_the_reports():
    command = [sys.executable, ROOT / "lab/report/per_cent.py", ROOT / "lab/evidence/report"]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout in TEXT


def test_the_page_is_short():
    prose = re.sub(r"^```.*?^```$", "", TEXT, flags=re.MULTILINE | re.DOTALL)
    assert len(" ".join(line for line in prose.splitlines() if not line.startswith("|")).split()) <= 2500
