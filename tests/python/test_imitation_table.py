"""The rows of the table of docs/guides/imitation.md, in a small form: every environment is imitated to the end.

With SPIKESERVE_WHOLE_TABLE each row runs as it is printed, which takes hours, and has to reach what the table says.
"""

import dataclasses
import importlib.util
import json
import os
import re
import sys

import pytest
import spikeserve
from documentation import DOCS, page_of
from serving import running_server
from spikeserve.imitation import pipeline
from spikeserve.imitation.options import ImitationOptions

sys.path.insert(0, str(DOCS.parent / "train/recipes"))  # the experts

SPIKETRAIN = os.environ["SPIKETRAIN"]
WHOLE = "SPIKESERVE_WHOLE_TABLE" in os.environ
ROWS = re.findall(r"^\| `(\S+)` \| `(\S+)` \|", page_of("imitation.md").read_text(), re.MULTILINE)
MODES = ("baseline", "dense")
SMALL = ImitationOptions(
    environments=4,
    learning_rate=0.003,
    steps=1200,
    burst_rate=0.1,
    longest_burst=2,
    context=2,
    clip_steps=2,
    action_noise=0.5,
    hidden_size=16,
    layers=1,
    ticks=4,
    batch=8,
    iterations=10,
    rounds=0,
    round_steps=150,
    round_iterations=5,
    silence_iterations=5,
    silence=(),
    selection_episodes=2,
    episodes=2,
    train_flags=("--heads=2",),
)


def test_the_table_has_all_rows():
    assert len(ROWS) == 8
    assert sum(name.startswith("hidden_state:") for name, _ in ROWS) == 5


def needs_mujoco(name):
    return name.startswith("InvertedDoublePendulum") and importlib.util.find_spec("mujoco") is None


@pytest.mark.parametrize(("name", "expert"), ROWS)
@pytest.mark.parametrize("mode", MODES if WHOLE else ["baseline"])
def test_a_row(tmp_path, monkeypatch, name, expert, mode):
    if needs_mujoco(name):
        pytest.skip("without mujoco")
    if not WHOLE:
        monkeypatch.setattr(pipeline, "LARGEST_COMPARED", 0)  # the baselines take seconds
    options = dataclasses.replace(ImitationOptions() if WHOLE else SMALL, mode=mode)
    result = spikeserve.imitate(name, expert, tmp_path, options=options, spiketrain=SPIKETRAIN)
    if not WHOLE:
        assert len(result.figures.returns) == 2
        return
    share = json.loads((tmp_path / "metadata.json").read_text())["share_of_the_way_to_the_expert"]
    assert share >= 0.95
    with running_server(result.policies) as addresses:
        policy = result.policy.parent.parent.name
        played = spikeserve.evaluate(name, policy, server=addresses.grpc, episodes=20, seed=2_000_000)
    served = result.figures if result.quantized_figures is None else result.quantized_figures
    assert played.mean_return == pytest.approx(sum(served.returns[:20]) / 20, abs=1e-4)
