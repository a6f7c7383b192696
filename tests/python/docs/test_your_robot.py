"""Runs every file and command of docs/start/your-robot.md, in order, as a reader does, with the robot far away."""

import os
import re

import pytest
from documentation import Shell, files_of
from links import Link

PAGE = "your-robot.md"


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_from_data_to_a_robot_that_learns(tmp_path):
    files = files_of(PAGE)
    assert list(files) == ["quad.py", "record.py", "fly.py"]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with Shell(tmp_path) as shell:
        # The robot is 50 ms away, and of the segments 1 % are lost.
        with Link(target=None, delay=0.025, loss=0.01) as link:
            # Each block has a shell of its own here, so the variable of an earlier block is set again.
            commands = [("python fly.py", f"SPIKESERVE_SERVER={link.address} python fly.py")]
            outputs = []
            for output in shell.run(PAGE, commands):
                outputs.append(output)
                link.target = shell.server
        _, _, evaluated, flown, watched, learned = outputs
    mean_return = float(re.search(r"quad/1 plays Quad-v0: return (-\d+\.\d)", evaluated)[1])
    assert mean_return > -40  # without torques: -81
    # All beats of both episodes are in the session, whoever has chosen their actions, and each is there once.
    returns = re.findall(r"episode \d: return (-\d+\.\d) in 200 beats", flown)
    assert len(returns) == 2, flown
    beats, *sources = map(int, re.search(r"(\d+) beats: (\d+) fresh, (\d+) held, (\d+) local, (\d+) safe", flown).groups())
    assert beats == 400 == sum(sources)
    assert sources[0] > 0
    elements = re.findall(r'unusual_observations_total\{element="(\d+)",policy="quad"', watched)
    assert sorted(map(int, elements)) == list(range(12))
    assert re.search(r"quad/1: drift 0\.\d+, 2 updates, 0 refused, 0 rollbacks", learned), learned
