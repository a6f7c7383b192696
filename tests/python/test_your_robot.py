"""Runs every file and every command of docs/your-robot.md, in order, as a reader does."""

import os
import re

import pytest
from documentation import Shell, files_of

PAGE = "your-robot.md"


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_from_data_to_a_robot_that_learns(tmp_path):
    files = files_of(PAGE)
    assert list(files) == ["quad.py", "record.py", "fly.py"]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with Shell(tmp_path) as shell:
        # A deadline of 20 ms and 50 Hz say nothing about a machine that runs other tests at the same time. The training
        # is as long as the page's, because the return at its end shows that the data were understood.
        edits = [("timeout=PERIOD", "timeout=30"), ("PERIOD = 0.02", "PERIOD = 0.0")]
        fly = tmp_path / "fly.py"
        for text, replacement in edits:
            assert text in fly.read_text()
            fly.write_text(fly.read_text().replace(text, replacement))
        # Each block has a shell of its own here, so the variable of an earlier block is set again.
        commands = [("python fly.py", "SPIKESERVE_SERVER=127.0.0.1:50051 python fly.py")]
        _, _, evaluated, flown, watched, learned = shell.run(PAGE, commands)
    mean_return = float(re.search(r"quad/1 plays Quad-v0: return (-\d+\.\d)", evaluated)[1])
    assert mean_return > -40  # without torques: -81
    returns = re.findall(r"episode \d: return (-\d+\.\d), 0 of 200 beats missed", flown)
    assert len(returns) == 2
    elements = re.findall(r'unusual_observations_total\{element="(\d+)",policy="quad"', watched)
    assert sorted(map(int, elements)) == list(range(12))
    assert re.search(r"quad/1: drift 0\.\d+, 2 updates, 0 refused, 0 rollbacks", learned), learned
