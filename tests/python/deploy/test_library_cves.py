"""The libraries that the server links, and what deploy/library_cves.py says of them."""

import json
import os
import pathlib
import sys

from serving import run

SCRIPT = pathlib.Path(__file__).parents[3] / "deploy/library_cves.py"


def table(*flags):
    """Returns the rows of the script's table by package."""
    lines = run(sys.executable, SCRIPT, os.environ["SPIKESERVE_PROGRAM"], *flags).stdout.splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: row[1:] for row in rows[2:]}


def test_the_server_links_nghttp2_with_its_fixes_and_no_grpc():
    rows = table()
    assert "CVE-2023-44487" in rows["libnghttp2-14"][1]  # rapid reset
    assert not [package for package in rows if "grpc" in package]
    assert b"grpc_server_create" not in pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).read_bytes()


def test_open_cves_come_from_the_tracker(tmp_path):
    def state(status):
        return {"releases": {"bookworm": {"status": status, "urgency": "low"}}}

    tracker = tmp_path / "tracker.json"
    tracker.write_text(json.dumps({"nghttp2": {"CVE-2099-1": state("open"), "CVE-2099-2": state("resolved")}}))
    rows = table(f"--tracker={tracker}")
    assert rows["libnghttp2-14"][2] == "CVE-2099-1 (low)"
    assert rows["zlib1g"][2] == "none"
