"""Runs the commands of documentation pages, in order, in an empty directory."""

import json
import os

import pytest
from documentation import Shell


@pytest.fixture
def shell(tmp_path):
    with Shell(tmp_path) as started:
        yield started


def test_serve_your_own_policy(shell, tmp_path):
    *_, drained = shell.run("policies.md")
    assert drained == "draining, open sessions: 0\nserving, open sessions: 0\n"
    assert (tmp_path / "my-policies/cartpole/2/policy.safetensors").exists()


def test_secure_it(shell):
    _, over_tls, _, with_tokens = shell.run("security.md")
    assert "cartpole-sparse" in over_tls
    assert over_tls.endswith("SERVING\n")
    assert "mean return" in with_tokens
    status = json.loads(with_tokens[with_tokens.index("{") :])
    assert status["serving"] is True


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_record_and_retrain(shell, tmp_path):
    recordings = tmp_path / "recordings"
    # The server writes an episode after it has answered, so replay waits for the third file.
    wait = f"until ls {recordings}/*/000002.cbor >{tmp_path}/listed 2>&1; do :; done"
    edits = [
        ("spikectl replay", f"{wait}\nspikectl replay"),
        ("/tmp/recordings", str(recordings)),
        ("--iterations=300", "--iterations=1"),
    ]
    _, played, replayed, trained = shell.run("recording.md", edits)
    assert "mean return 500.0" in played
    assert "1500 decisions of 3 episodes, all equal bit for bit" in replayed
    assert "return" in trained
    assert (tmp_path / "my-policies/cartpole/2/policy.safetensors").exists()
