"""`make bench` measures the engine, sessions and the server, and prints a row for each."""

import os
import pathlib
import re
import sys

from serving import run

BENCH = pathlib.Path(__file__).parents[3] / "loadtest/bench.py"


def test_every_row_has_figures():
    programs = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent
    lines = run(sys.executable, BENCH, f"--bin={programs}", "--seconds=0.2").stdout.splitlines()
    assert [line[:32].strip() for line in lines] == [
        *("policy cartpole", "engine, baseline", "engine, full", "memory, full"),
        *(f"server, {mode}, {count} sessions" for mode, count in (("unary", 1), ("unary", 64), ("stream", 64), ("batch", 64))),
    ]
    for line in [*lines[1:3], *lines[4:]]:
        assert float(re.search(r"([\d,]+)  ", line[32:])[1].replace(",", "")) > 0, line
    assert re.search(r"session [\d.]+ KiB, idle [\d.]+ KiB, engine 0\.\d+ MB$", lines[3])
