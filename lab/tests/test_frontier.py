"""The comparison at the frontier: its task, what rivals pay, and a miniature of the run."""

import csv
import os
import sys

import event_rivals
import event_watch
import frontier
import numpy as np
import pytest
from spikeserve.engine import Engine


def test_the_sum_of_events_shows_where_all_spots_are():
    environment = event_watch.EventWatch()
    observation, _ = environment.reset(seed=1)
    seen, zeros, total, over = np.zeros(frontier.PIXELS), [], 0.0, False
    while not over:
        seen += observation[: frontier.PIXELS]
        zeros.append(np.mean(observation == 0))
        spots = seen.reshape(event_watch.CAMERAS, -1).argmax(1)
        asked = observation[frontier.PIXELS :].argmax()
        observation, reward, over, _, _ = environment.step(spots[asked] * event_watch.ZONES // event_watch.PIXELS)
        total += reward
    assert total == pytest.approx(1) and np.mean(zeros) > 0.9
    assert set(np.unique(seen)) == {0, 1} and seen.sum() == event_watch.CAMERAS


def test_a_zero_costs_nothing_and_a_weight_of_a_pruned_matrix_costs_its_index():
    weights = np.array([[1.0, -1.0], [0.5, 0.25]])
    cost, pruned = event_rivals.Cost(), event_rivals.Cost()
    outputs = event_rivals.Map(weights, np.zeros(2))(np.array([0.0, 2.0]), cost, 1.25)
    assert outputs == pytest.approx([1, 0.5], abs=0.01)
    assert cost.arithmetic == pytest.approx(2 * 0.23 + 2 * (0.1 + 0.9)) and cost.memory == 1.25 * (2 + 2 * 2)
    event_rivals.Map(weights * [[1, 1], [1, 0]], np.zeros(2))(np.array([0.0, 2.0]), pruned, 1.25)
    assert pruned.arithmetic == pytest.approx(0.23 + 2) and pruned.memory == 1.25 * (2 * 1 + 2 + 2 * 2)


@pytest.mark.parametrize("kind", ["gru", "perceptron"])
def test_a_rival_in_8_bits_decides_as_the_one_that_was_trained(kind, tmp_path):
    random = np.random.default_rng(3)
    episode = (
        random.integers(-1, 2, (20, frontier.INPUTS)).astype(np.float32),
        random.integers(0, event_watch.ZONES, 20),
    )
    model, data = frontier.new_rival(kind, 8, 1, [episode])
    largest = [] if kind == "gru" else [value.max() for value in model.outputs(data[0])[1:-1]]
    np.savez(tmp_path / "rival.npz", *model.arrays, largest=largest)
    player, state, equal = frontier.rival_player(kind, tmp_path / "rival.npz"), np.zeros((1, 8)), 0
    player.begin()
    for t, observation in enumerate(episode[0]):
        if kind == "gru":
            outputs, state = model.outputs(observation[None], state)
        else:
            outputs = model.outputs(data[0][t : t + 1])[-1]
        equal += player.act(observation, 0.0, event_rivals.Cost()) == outputs.argmax()
    assert equal >= 18


def test_a_miniature_continues_where_it_was_interrupted(tmp_path, monkeypatch, capsys):
    small = "--seeds=1 --data_episodes=12 --starts=2 --epochs=1 --iterations=2 --quiet_iterations=2 --widths=8 --rival_widths=4"
    table = tmp_path / "runs.csv"
    flags = [f"--work={tmp_path}/work", f"--out={table}", *small.split(), "--level=-1"]
    monkeypatch.setattr(sys, "argv", ["frontier.py", *flags, f"--spiketrain={os.environ['SPIKETRAIN']}"])
    frontier.main()
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["kind"] for row in rows] == ["gru"] * 2 + ["perceptron"] * 2 + ["silent"] + ["baseline"] * 2 + ["dense"]
    assert all(float(row["sram_nanojoules"]) > float(row["nanojoules"]) > 0 for row in rows)
    for whole, pruned in zip(rows[0:4:2], rows[1:4:2], strict=True):
        assert float(pruned["nanojoules"]) < float(whole["nanojoules"])
    assert float(rows[4]["spikes"]) == 0 and all(
        float(row["nanojoules"]) > float(rows[4]["nanojoules"]) for row in rows[5:]
    )
    printed = capsys.readouterr().out
    assert all(f"cheapest {kind} with -1" in printed for kind in ("gru", "perceptron", "baseline", "dense"))
    monkeypatch.setattr(sys, "argv", ["frontier.py", *flags, "--spiketrain=/bin/false", "--again"])
    frontier.main()
    assert list(csv.DictReader(table.read_text().splitlines())) == rows

    monkeypatch.setattr(
        sys, "argv", [*sys.argv, "--context=4", "--modes=dense", f"--spiketrain={os.environ['SPIKETRAIN']}"]
    )
    frontier.main()
    both = list(csv.DictReader(table.read_text().splitlines()))
    assert both[:-1] == rows and (both[-1]["kind"], both[-1]["context"]) == ("dense", "4")

    decide_alike(*(tmp_path / "work/baseline-8-8-1" / f"{name}.safetensors" for name in ("policy", "centred")))


def decide_alike(policy, centred):
    """The centred one skips inputs of 0."""
    first, second = Engine(policy).session(), Engine(centred).session()
    environment = event_watch.EventWatch()
    (observation, _), over = environment.reset(seed=5), False
    while not over:
        decisions = [session.act(observation, 0.0) for session in (first, second)]
        assert decisions[1].logits == pytest.approx(decisions[0].logits, abs=1e-3)
        skipped = 8 * np.count_nonzero(observation == 0)
        assert decisions[1].stats.multiply_accumulates <= decisions[0].stats.multiply_accumulates - skipped // 2
        observation, _, over, _, _ = environment.step(0)


def test_the_cheapest_model_is_among_those_that_return_enough():
    def row(seed, setting, mean_return, joules):
        figures = dict.fromkeys(frontier.FIGURES, 1.0) | {"mean_return": mean_return, "sram_nanojoules": joules}
        return {"kind": "gru", "width": 8, "context": 0, "setting": setting, "seed": seed} | figures

    rows = [
        row(1, 0, 0.95, 3),
        row(2, 0, 0.93, 5),
        row(3, 0, 0.2, 4),
        row(1, 0.75, 0.99, 1),
        row(2, 0.75, 0.5, 1),
        row(3, 0.75, 0.5, 1),
    ]
    table = frontier.medians(rows)
    assert table["gru", 8, 0, 0.0]["mean_return"] == 0.93 and table["gru", 8, 0, 0.0]["sram_nanojoules"] == 4
    assert frontier.cheapest(table, 0.9) == {"gru": ("gru", 8, 0, 0.0)}
