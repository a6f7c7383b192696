"""The runs of the table of lab/evidence/imitators.md, in a small form: every environment is imitated to the end.

With SPIKESERVE_WHOLE_TABLE each runs with nothing but environment and expert, which takes hours, and has to come 95 %
of the way from random actions to its expert, and to be no worse than the baselines.
"""

import dataclasses
import json
import os
import pathlib
import re
import sys

import pytest
import spikeserve
from imitation_table import MODES, ROWS, main, short_name, table_row
from serving import running_server
from spikeserve.imitation import pipeline
from spikeserve.imitation.options import ImitationOptions

PAGE = pathlib.Path(__file__).parents[1] / "evidence/imitators.md"
SPIKETRAIN = os.environ["SPIKETRAIN"]
WHOLE = "SPIKESERVE_WHOLE_TABLE" in os.environ
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


def test_the_page_has_figures_for_every_run_that_it_names():
    rows = re.findall(r"^\| (\w+) \| ([^|]+) \|(.*)\|$", PAGE.read_text(), re.MULTILINE)
    rows = [(name, policy, cells) for name, policy, cells in rows if policy in MODES.values()]
    assert rows
    for name, policy, cells in rows:
        assert name in map(short_name, ROWS)
        *figures, eight_bit, spikes, way, _ = [cell.strip() for cell in cells.split("|")]
        assert len(figures) == 5 and all(figures) and way.endswith("%")
        assert bool(eight_bit and spikes) == (policy != "dense")


def test_the_program_of_the_table_continues_and_prints(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    flags = "--environments=3 --steps=300 --hidden-size=16 --batch=2 --iterations=2 --rounds=0 --train-flags=--heads=2"
    flags += " --episodes=2 --selection-episodes=2"
    arguments = [f"--out={tmp_path}", "--rows=Spring", "--modes=dense", f"--flags={flags}"]
    assert main(arguments) == 0
    printed = "python -m spikeserve imitate hidden_state:Spring-v0 --expert=hidden_state:hold --mode=dense"
    assert printed in capsys.readouterr().out
    (record,) = (tmp_path / "processor.jsonl").read_text().splitlines()
    assert json.loads(record)["processor"] > 0
    assert main(arguments) == 0
    assert capsys.readouterr().out == "", "it is finished"
    assert main([f"--out={tmp_path}", "--print"]) == 0
    *_, row = capsys.readouterr().out.splitlines()
    assert row.startswith("| Spring | dense | -")


def test_a_policy_that_lost_too_much_in_integers_has_its_row(tmp_path):
    folder = tmp_path / "Spring-baseline"
    (folder / "evaluations").mkdir(parents=True)
    (folder / "evaluations/chance.json").write_text(json.dumps({"returns": [-80.0, -90.0]}))
    figures = {"expert": {"returns": [-1.0]}, "spring/1, float32": {"returns": [-2.0], "spikes_per_decision": 208.4}}
    baselines = {"line on 1 frame": {"returns": [-3.0]}}
    (folder / "metadata.json").write_text(json.dumps({"figures": figures, "baselines": baselines}))
    (tmp_path / "processor.jsonl").write_text("")
    row = table_row(tmp_path, "hidden_state:Spring-v0", "baseline")
    assert row[-5:] == ["-2.00 ± 0.00", "", "208", "98.8%", "0"]


# Rows that a baseline passes by more than two standard errors, as the page says: MountainCarContinuous' line passes its expert, too.
PASSED_BY_A_BASELINE = {
    *(("MountainCarContinuous", mode) for mode in ("dense", "baseline")),
    *(("InvertedDoublePendulum", mode) for mode in ("dense", "baseline")),
    ("Thermostat", "baseline"),
}


@pytest.mark.parametrize(("name", "expert"), ROWS.items())
@pytest.mark.parametrize("mode", ("baseline", "dense") if WHOLE else ["baseline"])
def test_a_row(tmp_path, monkeypatch, name, expert, mode):
    if not WHOLE:
        monkeypatch.setattr(pipeline, "LARGEST_COMPARED", 0)  # the baselines take seconds
    options = dataclasses.replace(ImitationOptions() if WHOLE else SMALL, mode=mode)
    result = spikeserve.imitate(name, expert, tmp_path, options=options, spiketrain=SPIKETRAIN)
    if not WHOLE:
        assert len(result.figures.returns) == 2
        return
    metadata = json.loads((tmp_path / "metadata.json").read_text())
    assert metadata["share_of_the_way_to_the_expert"] >= 0.95
    best = max(result.baselines.values(), key=lambda figures: figures.mean)
    own = result.figures.of_the_first(len(best.returns))
    if (short_name(name), mode) not in PASSED_BY_A_BASELINE:
        assert own.mean >= best.mean - 2 * own.std / len(own.returns) ** 0.5
    with running_server(result.policies) as addresses:
        policy = result.policy.parent.parent.name
        played = spikeserve.evaluate(name, policy, server=addresses.grpc, episodes=20, seed=2_000_000)
    served = result.figures if result.quantized_figures is None else result.quantized_figures
    assert played.mean_return == pytest.approx(sum(served.returns[:20]) / 20, abs=1e-4)
