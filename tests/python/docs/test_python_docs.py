"""Runs every Python example of docs/start/python.md and docs/guides/imitation.md, in order."""

import re

import numpy as np
import spikeserve
from documentation import page_of, run_examples
from serving import DEPLOY, running_server


def outputs_of(page):
    """Returns the blocks without a language that follow a Python block at once: what the example prints."""
    return re.findall(r"^```python\n[^`]*^```\n\n```\n([^`]*)^```$", page_of(page).read_text(), re.MULTILINE)


def one_line(text):
    return " ".join(text.split())


def test_the_examples_run(address, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deploy").symlink_to(DEPLOY)
    run_examples("python.md", address)
    printed = capsys.readouterr().out
    outputs = outputs_of("python.md")
    assert [output.split()[0] for output in outputs] == ["cartpole/2", "EpisodeSummary(episode_return=500.0,", "Act:"]
    for output in outputs:
        assert one_line(output) in one_line(printed)
    assert "[100.0, 100.0, 100.0, 100.0]" in printed
    with running_server(tmp_path / "policies") as exported:
        evaluation = spikeserve.evaluate("Pendulum-v1", server=exported.grpc, episodes=1)
    assert evaluation.policy == "pendulum"
    assert np.isfinite(evaluation.mean_return)


def test_the_examples_of_imitation_run(address):
    run_examples("imitation.md", address)
