"""The generated pages of docs/reference are those of the programs. `make reference` writes them."""

import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[3]
PAGES = ("flags.md", "files.md", "metrics.md", "alerts.md", "errors.md", "policies.md")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    programs = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent
    subprocess.run([sys.executable, ROOT / "deploy/release/reference.py", programs, folder], check=True)
    return folder


@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_that_of_the_programs(written, page):
    assert (ROOT / "docs/reference" / page).read_text() == (written / page).read_text(), "run make reference"
