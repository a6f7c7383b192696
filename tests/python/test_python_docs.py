"""Runs every Python example of docs/python.md and docs/imitation.md, in order."""

import numpy as np
import spikeserve
from documentation import run_examples
from serving import DEPLOY, running_server


def test_the_examples_run(address, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deploy").symlink_to(DEPLOY)
    run_examples("python.md", address)
    printed = capsys.readouterr().out
    assert "cartpole/2 plays CartPole-v1: return 500.0 " in printed
    assert "Act: INVALID_ARGUMENT: observation: expected 4 numbers, received 3" in printed
    assert "[100.0, 100.0, 100.0, 100.0]" in printed
    with running_server(tmp_path / "policies") as exported:
        evaluation = spikeserve.evaluate("Pendulum-v1", server=exported.grpc, episodes=1)
    assert evaluation.policy == "pendulum"
    assert np.isfinite(evaluation.mean_return)


def test_the_examples_of_imitation_run(address):
    run_examples("imitation.md", address)
