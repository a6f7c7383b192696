"""The study: its statistics, its verdicts, a miniature of it, and the committed page."""

import csv
import io
import json
import math
import os
import pathlib
import subprocess
import sys

import pytest
from safetensors import safe_open
from spikeserve.imitation.datasets import read_dataset

ROOT = pathlib.Path(__file__).parents[2]
STUDY = ROOT / "lab/study"
import seed_statistics
import study_field
import study_integers
import study_page
import study_parts
import study_plan
import study_run
import study_settings
import study_structured
import study_tables
import study_tasks
from run_table import OF_ONE_FILE, add_result, mixed_figures, name_of, read_results

COMMITTED = ROOT / "lab/study/runs"


@pytest.mark.parametrize(("freedom", "t"), [(1, 12.7062), (2, 4.30265), (3, 3.18245), (4, 2.77645), (9, 2.26216), (30, 2.04227)])
def test_student_has_the_quantiles_of_the_tables(freedom, t):
    assert seed_statistics.student_share(t, freedom) == pytest.approx(0.95, abs=1e-6)


@pytest.mark.parametrize(
    ("freedom", "t", "p"),
    [(1, 0.5, 0.7048327647), (2, 3, 0.09546596627), (3, 2, 0.13932596856), (4, 12, 2.764285485e-4), (9, 8, 2.213481681e-5), (30, 6, 1.394276877e-6)],
)
def test_student_has_the_p_values_of_scipy(freedom, t, p):
    assert 1 - seed_statistics.student_share(t, freedom) == pytest.approx(p)


def test_p_values_are_those_of_student():
    sample = [1, 2, 3, 4, 5]
    assert seed_statistics.two_sided(sample, 0) == pytest.approx(0.0132363, abs=1e-6)
    assert seed_statistics.probability_below(sample, 3) == pytest.approx(0.5)
    assert seed_statistics.equivalence(sample, 5) == pytest.approx(seed_statistics.probability_below(sample, 5))
    assert seed_statistics.equivalence([0.1, -0.2, 0.05], 5) < 0.001
    assert seed_statistics.equivalence([4, -5, 3], 5) > 0.05
    assert seed_statistics.two_sided([2, 2, 2], 0) == 0
    assert seed_statistics.two_sided([2, 2, 2], 2) == 1
    assert seed_statistics.half_width(sample) == pytest.approx(2.77645 * math.sqrt(2.5 / 5), abs=1e-4)


def test_holm_corrects_the_smallest_most():
    assert seed_statistics.holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert seed_statistics.holm([0.9, 0.8]) == [1, 1]


def test_interquartile_means_leave_out_the_ends():
    assert seed_statistics.interquartile_mean([0, 2, 3, 100]) == 2.5
    assert seed_statistics.interquartile_mean([1, 3]) == 2
    low, high = seed_statistics.bootstrap_interval([[1, 2, 3, 4, 5, 6, 7, 8]])
    assert 1 < low < 4.5 < high < 8
    assert seed_statistics.bootstrap_interval([[1, 1, 1], [3, 3, 3]]) == (2, 2)


# The figures of a policy in integers, of one file.
SERVED = dict.fromkeys(OF_ONE_FILE, 2) | {"sha256": "1e5"}


def served(value, starts=100):
    """Returns the part of a result that has the figures of the policy as it is served."""
    return {"integer": SERVED | {"mean_return": value, "starts": starts, "first_start": 1}, "starts": 100, "first_start": 1}


def test_an_energy_stands_beside_the_return_of_the_same_file():
    assert list(mixed_figures({"mean_return": 1, "starts": 100})) == []
    assert list(mixed_figures(served(1.0))) == []
    assert list(mixed_figures(served(1.0, starts=5))) == ["integer: expected the starts of the run, received others"]
    without = served(1.0)
    del without["integer"]["sha256"]
    assert list(mixed_figures(without)) == ["integer: expected sha256 beside an energy, received none"]
    assert list(mixed_figures({"mean_return": 1, "nanojoules_per_decision": 2}))


@pytest.mark.parametrize("group", [study_tables.FORMER, "study", "paper", "sweep", "settings", "structured", "field"])
def test_no_committed_table_mixes_files(group):
    results = read_results(COMMITTED, group)
    assert results
    assert [(name_of(result, group), text) for result in results for text in mixed_figures(result)] == []
    assert [name_of(result, group) for result in results if "integer" in result and "sha256" not in result] == []


def write_results(folder, arms):
    """Writes results of CartPole with the returns of each arm by seed."""
    for arm, returns in arms.items():
        for seed, value in enumerate(returns, 1):
            result = {"task": "cartpole", "arm": arm, "seed": seed, "learning_rate": "1e-3", "mean_return": value}
            result |= {"spikes_per_decision": 5, "validation_loss": 0.1} | served(value)
            add_result(folder, "study", result)


def test_verdicts(tmp_path):
    noise = [1.0, -2.0, 0.5, 1.5, -1.0, 0.3, -0.7, 2.0, -1.6, 0.2]
    apart = [80.0 * (-1) ** seed + value for seed, value in enumerate(noise)]
    write_results(
        tmp_path,
        {
            "dense": [180 + value for value in noise],
            "baseline": [350.0] * 10,
            "pos": [350 + value for value in noise],
            "route": [350 + value for value in apart],
            "full": [400 - value for value in noise],
            "full-n1": [400.0 + 60],
        },
    )
    results = study_page.results_of(tmp_path)
    tests = study_page.tests_of(results)
    verdicts = {statement.text.split(" (")[0]: test.verdict for (statement, task), test in tests.items() if task == "cartpole"}
    assert verdicts == {
        "`full` returns at most 5 points less than `dense`": "holds",
        "`pos` returns more than `baseline`": "does not hold, equal",
        "`route` returns more than `baseline`": "cannot be told",
        "`full` returns more than `baseline`": "holds",
        "`full` returns more than `pos`": "holds",
        "`full` returns more than `route`": "cannot be told",
        "`route` halves the loss of `baseline`": "does not hold",
        "`full` returns more than trained with N = 1": "cannot be told",  # one seed
    }
    assert "| cartpole | `baseline` | 10 | 350.0 (350.0 to 350.0) | 2 | 2 | 2.0 | 1e-3 |" in study_page.tables(tmp_path)
    assert "| cartpole | `full-n1` | 1 | 460.0 (one seed) | 2 | 2 | 2.0 | 1e-3 |" in study_page.tables(tmp_path)


@pytest.mark.parametrize(("place", "verdict"), [(498.0, "cannot be told, no room"), (28.0, "cannot be told, no room"), (300.0, "does not hold, equal")])
def test_arms_are_equal_only_where_they_could_differ(tmp_path, place, verdict):
    noise = [0.5, -0.4, 0.2, -0.3, 0.1]
    write_results(tmp_path, {"baseline": [place] * 5, "pos": [place + value for value in noise]})
    tests = study_page.tests_of(study_page.results_of(tmp_path))
    test = tests[study_page.STATEMENTS[1], "cartpole"]
    assert test.verdict == verdict
    # Six of the eight statements, on five tasks.
    assert test.equal == pytest.approx(30 * seed_statistics.equivalence(test.values, study_page.MARGIN))


def test_a_p_value_near_the_limit_is_called_so():
    texts = [str(study_page.Test(study_page.STATEMENTS[1], [1.0, 2.0], p, 1.0)).split("**")[1] for p in (0.01, 0.0498, 0.0518, 0.3)]
    assert texts == ["holds", "holds, near the limit", "cannot be told, near the limit", "cannot be told"]


@pytest.mark.parametrize(("less", "verdict"), [(10, "holds"), (100, "does not hold")])
def test_less_within_the_margin_is_not_worse(tmp_path, less, verdict):
    dense = [500, 499, 500, 498]
    write_results(tmp_path, {"dense": dense, "full": [value - less - seed for seed, value in enumerate(dense)]})
    tests = study_page.tests_of(study_page.results_of(tmp_path))
    assert tests[study_page.STATEMENTS[0], "cartpole"].verdict == verdict


def test_no_run_looks_further_back_than_its_context():
    tasks = list(study_tasks.TASKS)
    for run in [*study_plan.study_runs(tasks, 1), *study_plan.part_runs(tasks, 1)]:
        flags = dict(flag.split("=") for flag in study_plan.train_flags(run, "1e-3", study_plan.Budget()) if "=" in flag)
        assert int(flags.get("--lookback", 0)) < int(flags["--context"]), run.name


def test_no_table_ranks_former_runs_beside_present_ones(tmp_path):
    write_results(tmp_path, {"baseline": [350.0, 360.0]})
    assert "| cartpole | `baseline` | 2 | 355.0" in study_page.tables(tmp_path)
    former = {"task": "cartpole", "arm": "pos", "seed": 1, "learning_rate": "1e-3", "mean_return": 9.0, "spikes_per_decision": 5}
    add_result(tmp_path, study_tables.FORMER, former | {"validation_loss": 0.1})
    text = study_page.tables(tmp_path)
    assert "| cartpole | `pos` | 1 | 9.0 (one seed) | 5 |" in text and "`baseline` | 2" not in text


def test_the_table_of_the_integers(tmp_path):
    """Losses are points of the score; what the gate refused has what it lost before and after it was trained through."""
    for seed, (float32, rounded, integer) in enumerate([(500.0, None, 490.0), (500.0, 300.0, 495.0), (500.0, None, 500.0)], 1):
        result = {"task": "CartPole-v1", "arm": "pos", "seed": seed, "learning_rate": "1e-3", "mean_return": float32}
        result["integer"] = SERVED | {"mean_return": integer, "refused": 0}
        add_result(tmp_path, "paper", result | ({"rounded": SERVED | {"mean_return": rounded, "refused": 1}} if rounded else {}))
    text = study_integers.tables(tmp_path)
    assert "| CartPole-v1 | `pos` | 3 | 500.0 | 495.0 | 1.0 | 2.1 | 1 | 41.8 to 1.0 | 2 |" in text
    assert text.startswith("3 runs lose 1.0 points of 100 in the median, at most 2.1 in a file that is served. The gate")
    assert "refused 1 roundings; 1 were trained through it, after which it refuses 0. Refused and served by no server: 0." in text


class Refused(study_run.Workshop):
    """Takes every rounding for refused, also those of policies that have nothing to lose."""

    def _gate(self, integer, loss):
        figures = super()._gate(integer, loss)
        return figures | {"refused": 1, "range": figures["range"] or 1.0}


@pytest.mark.parametrize(("task", "mode"), [("CartPole-v1", "pos"), ("repeat-4", "full")])
def test_what_the_gate_refuses_is_trained_through_the_rounding(tmp_path, task, mode):
    run = study_plan.Run(task, mode, 1)
    result = Refused(tmp_path, os.environ["SPIKETRAIN"], study_plan.SMOKE).carry_out(run, "1e-3")
    assert len({result["sha256"], result["rounded"]["sha256"], result["integer"]["sha256"]}) == 3
    assert list(mixed_figures(result)) == []
    with safe_open(tmp_path / run.name / "integer/policy.safetensors", framework="np") as file:
        record = json.loads(file.metadata()["training"])
    assert "--arithmetic=integer" in record["command"] and f"--init={run.name}/policy.safetensors" in record["command"]


def study(folder, *arguments):
    program = [sys.executable, STUDY / "study.py", "--smoke", f"--work={folder}/work", f"--out={folder}/out", *arguments]
    paths = os.pathsep.join([os.environ["PYTHONPATH"], str(ROOT / "lab/recipes")])
    return subprocess.run(program, check=False, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths})


def results_in(folder, group):
    return {name_of(result, group): result for result in read_results(folder / "out", group)}


def started(finished):
    assert finished.returncode in (0, 1), finished.stderr
    return [line.removeprefix("study: ") for line in finished.stderr.splitlines() if line.startswith("study: ")]


def untimed(table):
    """Returns the rows of a table without what a decision took."""
    rows = csv.DictReader(io.StringIO(table))
    return [{key: value for key, value in row.items() if not key.endswith("microseconds_per_decision")} for row in rows]


def test_a_miniature(tmp_path):
    """It has a row for each run and a page, and continues with what is missing."""
    one = study(tmp_path, "--only=cartpole-full-1")  # plays in spiketrain; the others play in Gymnasium
    assert (one.returncode, one.stdout) == (0, ""), one.stderr
    whole = study(tmp_path, "--tasks=repeat-4", "--seeds=1", "--jobs=2")
    assert whole.returncode == 0, whole.stderr
    assert len(started(whole)) == len(study_plan.RATES) * len(study_plan.SWEEP_SEEDS) + len(study_plan.ARMS)
    results = results_in(tmp_path, "study")
    assert results.keys() == {"cartpole-full-1", *(f"repeat-4-{arm}-1" for arm in study_plan.ARMS)}
    for name, result in results.items():
        assert math.isfinite(result["mean_return"]), name
        assert result["first_start"] == study_plan.FIRST_UNSEEN_SEED
        assert result["integer"]["int_sram_nanojoules_per_decision"] > result["integer"]["int_nanojoules_per_decision"] > 0, name
        assert list(mixed_figures(result)) == [], name
        assert (result["spikes_per_decision"] > 0) == (result["arm"] != "dense"), name
        assert result["integer"]["refused"] in (0, 1) and math.isfinite(result["integer"]["lost"]), name
    assert "--context=1" in results["repeat-4-full-n1-1"]["training"].split()

    table = tmp_path / "out/study.csv"
    before = table.read_text()
    rows = before.splitlines(keepends=True)
    (lost,) = (row for row in rows if row.startswith("repeat-4,route,1,"))
    table.write_text("".join(row for row in rows if row != lost))
    assert started(study(tmp_path, "--tasks=repeat-4", "--seeds=1")) == ["repeat-4-route-1"]
    assert untimed(table.read_text()) == untimed(before)
    table.write_text(before.replace(lost, lost.replace("--batch=2", "--batch=3")))
    other = study(tmp_path, "--tasks=repeat-4", "--seeds=1")
    assert other.returncode == 1
    assert "study.csv, repeat-4-route-1: expected a run of --mode=route" in other.stderr

    page = tmp_path / "page.md"
    page.write_text("before\n" + "".join(f"{begin}\nold\n{end}\n" for begin, end, _ in study_page.GENERATED) + "after\n")
    subprocess.run([sys.executable, STUDY / "study_page.py", tmp_path / "out", page], check=True)
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("\nafter\n") and "\nold\n" not in text
    assert "Finished: 7 of 300 runs, at least 0 and at most 1 seeds of a task and arm." in text
    assert "| score over all tasks |" not in text  # no seed has every task
    assert "| repeat-4 | `full` | 1 | " in text


def test_a_miniature_of_the_parts(tmp_path):
    """Parts train and play, `full` also in longer contexts, and have their cells in the tables."""
    parts = ("router-activity", "context-50", "hebbian-instead-1e-2", "pos-quarter", "pos-half")
    for arm in ("pos", "full", *parts):
        only = study(tmp_path, f"--only=cartpole-{arm}-1", "--tasks=cartpole")
        assert only.returncode == 0, only.stderr
    planned = study_plan.part_runs(["cartpole", "memory"], 2)
    assert {(run.task, run.arm) for run in planned} == {("cartpole", arm) for arm in study_plan.PARTS}
    results = results_in(tmp_path, "study")
    assert "integer" not in results["cartpole-pos-half-1"]
    assert results["cartpole-full-1"]["longer"].keys() == {"20", "50"}
    assert "--context=50" in results["cartpole-context-50-1"]["training"]
    text = study_parts.tables(tmp_path / "out")
    assert "| `router-activity` | " in text
    assert "| cartpole, trained with N = 10 | N = 10 | N = 20 | N = 50 | seeds |" in text
    assert "| cartpole, `pos` | " in text
    longer = study_plan.train_flags(study_plan.Run("cartpole", "context-100", 1), "1e-3", study_plan.Budget())
    assert {"--context=100", "--clip_steps=100", "--batch=2"} <= set(longer)


def test_a_miniature_of_the_settings(tmp_path):
    """A run with the paper's settings has the losses of its epochs, and a table and a figure."""
    for mode in ("baseline", "full"):
        only = study(tmp_path, "--settings", f"--only=cartpole-table1-{mode}-1")
        assert only.returncode == 0, only.stderr
    results = results_in(tmp_path, "settings")
    assert results.keys() == {"cartpole-table1-baseline-1", "cartpole-table1-full-1"}
    assert all(len(result["losses"]) == 1 for result in results.values())
    flags = {"--weight_decay=1e-2", "--schedule=constant", "--padding=front", "--learning_rate=3e-4"}
    assert flags <= set(results["cartpole-table1-full-1"]["training"].split())
    program = [sys.executable, STUDY / "study_curves.py", tmp_path / "out", tmp_path / "curves.png"]
    subprocess.run(program, check=True)
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_a_step_of_each_mode_is_timed(tmp_path):
    program = [sys.executable, STUDY / "step_time.py", "--smoke", "--rounds=1", f"--work={tmp_path}"]
    program.append(f"--spiketrain={os.environ['SPIKETRAIN']}")
    printed = subprocess.run(program, check=True, capture_output=True, text=True).stdout.splitlines()
    assert [line.split(" | ")[0] for line in printed[2:]] == [f"| `{mode}`" for mode in study_plan.MODES]
    assert printed[3].split(" | ")[2] == "1.00"  # `baseline` against itself


def test_a_miniature_of_the_field(tmp_path):
    """Sets are made from nothing; policies and models without attention learn from them, and have their cells in the tables."""
    for is_first in (True, False):  # the second time it keeps the sets
        made = subprocess.run(
            [sys.executable, "-c", "import offline_sets; offline_sets.SHARE = 0.01; offline_sets.main()", "Hopper-v5"]
            + [f"--out={tmp_path}/sets", "--steps=400"],
            check=True,
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([os.environ["PYTHONPATH"], str(ROOT / "lab/recipes")])},
        )
        assert ("hopper-medium-v0: " in made.stdout) == is_first
    sets = {kind: list(read_dataset(tmp_path / f"sets/hopper-{kind}-v0")) for kind in study_tasks.SETS}
    steps = {kind: sum(episode.steps for episode in episodes) for kind, episodes in sets.items()}
    assert steps["medium"] >= 400 and steps["medium-expert"] >= 400 and 0 < steps["medium-replay"] <= 400
    assert max(e.episode_return for e in sets["medium-expert"]) > max(e.episode_return for e in sets["medium"])
    assert all(episode.terminated != episode.truncated for episode in sets["medium-replay"])

    arms = ("dense", "quiet", "cloning-10", "recurrent")
    for arm in arms:
        only = study(tmp_path, "--field", f"--sets={tmp_path}/sets", f"--only=hopper-medium-expert-{arm}-1")
        assert only.returncode == 0, only.stderr
    results = results_in(tmp_path, "field")
    assert results.keys() == {f"hopper-medium-expert-{arm}-1" for arm in arms}
    assert list(mixed_figures(results["hopper-medium-expert-quiet-1"])) == []
    assert results["hopper-medium-expert-cloning-10-1"]["multiplications"] == 11 * 256 + 256 * 256 + 256 * 3
    text = study_field.tables(tmp_path / "out")
    assert "| hopper-medium-expert | " in text
    assert "| multiplications |  |  |  |  |  | 69120 | 14784 |" in text


def test_a_miniature_of_the_structured_tasks(tmp_path):
    """Policies and models without attention learn from the same data, and have their cells in the tables."""
    arms = ("line", "perceptron-64", "recurrent-64", "dense", "spiking")
    for arm in arms:
        only = study(tmp_path, "--structured", f"--only=recall-{arm}-1")
        assert only.returncode == 0, only.stderr
    assert [path.name for path in (tmp_path / "work/data").glob("*-v0")] == ["recall-1-v0"]
    results = results_in(tmp_path, "structured")
    assert results.keys() == {f"recall-{arm}-1" for arm in arms}
    assert {"--mode=baseline", "--ticks=2", "--iterations=2"} <= set(results["recall-spiking-1"]["training"].split())
    assert results["recall-spiking-1"]["spikes_per_decision"] > 0
    assert {"--hidden=64", "--queue=16"} <= set(results["recall-perceptron-64-1"]["training"].split())
    assert results["recall-perceptron-64-1"]["multiplications"] == 16 * 21 * 64 + 64 * 64 + 64 * 4
    text = study_structured.tables(tmp_path / "out")
    assert "| recall | -0.500 | 1.000 | " in text
    assert "| difference of the returns |" not in text  # it takes two seeds
    assert "| 1344 | 25856 |  | 16768 |  |" in text


def test_spiking_arms_have_what_a_structured_task_needs():
    flags = {
        arm: study_plan.train_flags(study_plan.Run("autoencode", arm, 1), "3e-3", study_plan.Budget())
        for arm in ("dense", "spiking")
    }
    assert {"--mode=pos", "--mirror=51", "--ticks=2"} <= set(flags["spiking"])
    assert "--mode=dense" in flags["dense"] and "--mirror=51" not in flags["dense"]
    runs = study_plan.structured_runs()
    assert len(runs) == 3 * 9 * 7
    assert {(run.task, run.arm) for run in runs if study_plan.is_former(run)} == {
        ("repeat-64", "spiking"),
        ("concentration", "spiking"),
    }
    swept = study_plan.structured_sweep_runs()
    assert {run.task for run in swept} == {"count-recall", "memory-13"}
    assert len(swept) == 2 * len(study_plan.RATES) * len(study_plan.SWEEP_SEEDS)


def test_structured_returns_are_compared_with_the_best_other(tmp_path):
    """The best model without attention is that of the highest mean; differences are those of the same seed."""
    for arm, returns in {"line": (0.1, 0.3), "recurrent-64": (0.4, 0.2), "dense": (1.0, 1.0), "spiking": (0.9, 0.5)}.items():
        for seed, value in enumerate(returns, 1):
            result = {"task": "recall", "arm": arm, "seed": seed, "mean_return": value, "spikes_per_decision": 3}
            further = served(value) if arm in ("dense", "spiking") else {"multiplications": 5}
            add_result(tmp_path, "structured", result | further)
    text = study_structured.tables(tmp_path)
    assert "| recall | `recurrent-64` | +0.700 ± 1.271 | +0.400 ± 1.271 | -0.300 ± 2.541 |" in text
    assert "| recall | -0.500 | 1.000 | 0.200 ± 1.271 |  |  | 0.300 ± 1.271 |  | 1.000 ± 0.000 | 0.700 ± 2.541 | 0 to 2 |" in text


def test_scores_of_the_field_are_means_of_all_sets(tmp_path):
    for task, plan in study_tasks.FIELD_TASKS.items():
        for place, arm in enumerate(study_plan.FIELD_ARMS):
            for seed in (1, 2, 3):
                score = 10 * place + seed + (9 if task == "hopper-medium" else 0)
                value = plan.chance + score / 100 * (plan.expert_return - plan.chance)
                result = {"task": task, "arm": arm, "seed": seed, "mean_return": value, "spikes_per_decision": 7}
                further = {"multiplications": 5} if arm in study_plan.CLONES else served(value)
                add_result(tmp_path, "field", result | further)
    text = study_field.tables(tmp_path)
    assert "| hopper-medium | 11.0 ± 2.5 | 21.0 ± 2.5 | 31.0 ± 2.5 | 41.0 ± 2.5 | 51.0 ± 2.5 | 61.0 ± 2.5 | 71.0 ± 2.5 | 3 |" in text
    assert "| mean of 9 | 3.0 ± 2.5 | 13.0 ± 2.5 |" in text
    assert "| nJ with memory | 2 | 2 | 2 | 2 |  |  |  |" in text
    assert "| nJ without | 2.0 | 2.0 | 2.0 | 2.0 |  |  |  |" in text


def test_a_run_of_the_settings_has_the_papers_epochs():
    settings = study_tasks.SETTINGS
    assert (settings["table1"].epoch, settings["table5"].epoch) == (7, 11)
    flags = study_plan.train_flags(study_plan.Run("pendulum-table5", "full", 1), "1e-4", study_plan.Budget())
    assert {"--batch=16", "--context=50", "--iterations=2200", "--validate_every=55", "--hidden_size=128"} <= set(flags)
    assert len(study_plan.settings_runs()) == 2 * 4 * 5


def test_the_table_of_the_settings_compares_with_baseline(tmp_path):
    curves = {"baseline": [0.6, 0.5, 0.45, 0.4], "pos": [0.5, 0.4, 0.35, 0.2], "route": [0.6, 0.6, 0.6, 0.5]}
    for arm, losses in curves.items():
        result = {"task": "acrobot-table1", "arm": arm, "seed": 1, "mean_return": -80.0, "spikes_per_decision": 3}
        result["losses"] = dict(zip(("5", "20", "40", "50"), losses, strict=True))
        add_result(tmp_path, "settings", result)
    text = study_settings.tables(tmp_path)
    assert "| acrobot-table1 | epoch 20 | epoch 50 | lowest, of `baseline`'s | speed | return | spikes |" in text
    assert "| `baseline` | 0.500 | 0.400 |  |  | -80.0 | 3 |" in text
    assert "| `pos` | 0.400 | 0.200 | 0.50 | 2.50 | -80.0 | 3 |" in text
    assert "| `route` | 0.600 | 0.500 | 1.25 | never | -80.0 | 3 |" in text


def test_the_study_orders_seeds_before_tasks():
    runs = study_plan.study_runs([*study_tasks.TASKS, *study_tasks.TASKS_OF_THE_PAPER], 2)
    assert len(runs) == 2 * (5 * len(study_plan.ARMS) + 4 * len(study_plan.MODES))
    half = len(runs) // 2
    assert {run.seed for run in runs[:half]} == {1}
    assert {run.name for run in runs[half:]} == {run.name.removesuffix("1") + "2" for run in runs[:half]}


def test_the_page_is_that_of_the_committed_runs():
    text = (ROOT / "lab/evidence/study.md").read_text()
    for begin, end, generate in study_page.GENERATED:
        written = text.split(begin)[1].split(end)[0]
        assert written == f"\n{generate(COMMITTED)}\n", "run python lab/study/study_page.py"


@pytest.mark.parametrize("group", [study_tables.FORMER, "sweep", *study_tasks.GROUPS])
def test_the_committed_runs_have_the_settings_of_the_plan(group):
    budget = study_plan.Budget()
    results = read_results(COMMITTED, group)
    assert results
    for result in results:
        rate = result["learning_rate"]
        run = study_plan.Run(result["task"], result["arm"], result["seed"], rate if group == "sweep" else None)
        assert (run.group, run.name) == ("study" if group == study_tables.FORMER else group, name_of(result, group))
        assert result["training"] == " ".join(study_plan.train_flags(run, rate, budget))
        assert (result["starts"], result["first_start"]) == (budget.starts, run.first_start)
        settings = run.plan.settings
        assert not settings or list(result["losses"]) == [str(epoch) for epoch in range(5, settings.epochs + 1, 5)]


def test_a_table_keeps_every_value(tmp_path):
    one = {"task": "a", "arm": "b", "seed": 2, "learning_rate": "2e-3", "training": "--x=1 --y=2,3", "mean_return": 1 / 3}
    two = {"task": "a", "arm": "b", "seed": 1, "learning_rate": "", "training": "", "starts": 5, "longer": {"20": -1e-9}}
    for result in (one, two, one):
        add_result(tmp_path, "study", result)
    assert read_results(tmp_path) == [two, one]
    assert [path.name for path in tmp_path.iterdir()] == ["study.csv"]
