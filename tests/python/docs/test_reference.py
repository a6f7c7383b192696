"""The generated pages of docs/reference are those of the programs (`make reference`), and its limits have tests."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[3]
ROWS = [line for line in (ROOT / "docs/reference/limits.md").read_text().splitlines() if line.startswith("| ")][2:]
PAGES = ("flags.md", "files.md", "metrics.md", "alerts.md", "errors.md", "policies.md")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    programs = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent
    subprocess.run([sys.executable, ROOT / "deploy/release/reference.py", programs, folder], check=True)
    return folder


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_that_of_the_programs(written, page):
    assert (ROOT / "docs/reference" / page).read_text() == (written / page).read_text(), "run make reference"


def names_of(row):
    return re.findall(r"`(\w+)`", row.rsplit("|", 2)[1])


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_a_limit_has_a_test(row, defined):
    assert names_of(row)
    assert set(names_of(row)) <= defined


RULES = re.compile(r"rpc (\w+)\(.*?\(rules\) = \{access: (\w+), cost: (\w+)\}", re.DOTALL)
CONTRACT = [ROOT / f"proto/spikeserve/v1/{name}.proto" for name in ("policy_service", "policy_admin")]


@pytest.mark.parametrize(
    ("begin", "rule"),
    [
        ("| `ListSessions`", "ACCESS_VIEWER"),
        ("| decisions |", "COST_DECISION"),
        ("| `light` |", "COST_LIGHT"),
        ("| `listing` |", "COST_LISTING"),
        ("| `explain` |", "COST_EXPLAIN"),
    ],
)
def test_the_guide_has_the_rules_of_every_method(begin, rule):
    rules = {name: of_method for path in CONTRACT for name, *of_method in RULES.findall(path.read_text())}
    (row,) = (line for line in (ROOT / "docs/guides/security.md").read_text().splitlines() if line.startswith(begin))
    assert set(re.findall(r"`(\w+)`", row)) & rules.keys() == {name for name, of_method in rules.items() if rule in of_method}
