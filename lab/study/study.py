"""Trains the study: every arm on every task from ten seeds (study_tasks.py, study_plan.py). Writes a
row for each run.

    python lab/study/study.py --work=build/study --out=lab/study/runs
    python lab/study/study.py --work=build/study --out=lab/study/runs --parts
    python lab/study/study.py --work=build/study --out=lab/study/runs --settings
    python lab/study/study.py --work=build/study --out=lab/study/runs --field
    python lab/study/study.py --work=build/study --out=lab/study/runs --structured

Needs `spiketrain` and a Python with what docs/guides/imitation.md installs, popgym and minigrid; PYTHONPATH names
lab/recipes. The learning rate of `dense` is chosen first. The same command continues after an interruption, and
leaves out what is finished. `--jobs=2` runs two processes. Each of these trains something else instead: `--parts` the variants
of one mode, `--settings` the modes on the paper's tasks with the paper's settings, `--structured` a dense and a spiking policy
and models without attention on tasks that should need it, and `--field` some modes and models without attention on datasets of
MuJoCo. Those that the folder of `--sets` lacks are made by offline_sets.py; D4RL's, in Minari's format and under the same
names, are read as well. study_page.py makes a page of the tables.
"""

import argparse
import concurrent.futures
import pathlib
import statistics
import subprocess
import sys

import study_plan
import study_tasks
from run_table import add_result, name_of, read_results
from spikeserve.imitation.training import find_spiketrain
from study_run import Workshop


class Study:
    """The tables of a study."""

    def __init__(self, out, budget):
        self._out = out
        self._budget = budget

    def results(self, group):
        """Returns the results of a group by the names of their runs."""
        return {name_of(result, group): result for result in read_results(self._out, group)}

    def add(self, run, result):
        add_result(self._out, run.group, result)

    def rate_of(self, run):
        """Returns the learning rate of a run. That of `dense` is the best of the sweep."""
        known = run.rate or (run.plan.rate_of_dense if run.arm == "dense" else run.plan.rate)
        if known:
            return known
        means, swept = {}, self.results("sweep")
        for tried in study_plan.sweep_runs([run.task]):
            means.setdefault(tried.rate, []).append(swept[tried.name]["mean_return"])
        return max(means, key=lambda rate: statistics.fmean(means[rate]))

    def is_finished(self, run):
        """Returns whether the run has its row. RuntimeError if the row is one of other settings."""
        result = self.results(run.group).get(run.name)
        if result is None:
            return False
        expected = " ".join(study_plan.train_flags(run, self.rate_of(run), self._budget))
        received = result["training"]
        if received != expected:
            raise RuntimeError(f"{run.group}.csv, {run.name}: expected a run of {expected}, received one of {received}")
        return True


def run_named(name, tasks, seeds):
    runs = [*study_plan.settings_runs(), *study_plan.sweep_runs(tasks), *study_plan.study_runs(tasks, seeds)]
    runs += [*study_plan.part_runs(tasks, seeds), *study_plan.field_runs()]
    runs += [*study_plan.structured_sweep_runs(), *study_plan.structured_runs()]
    run = next((run for run in runs if run.name == name), None)
    if run is None:
        sys.exit(f"study: --only: expected a run of the plan, such as {runs[-1].name}, received {name}")
    return run


def train_all(study, runs, command, jobs):
    """Runs every run in a process of its own that `spiketrain` has the options of. Returns whether all succeeded."""
    open_runs = [run for run in runs if not study_plan.is_former(run) and not study.is_finished(run)]

    def train(run):
        sys.stderr.write(f"study: {run.name}\n")  # whole: print() writes the end of the line on its own
        return subprocess.run([*command, f"--only={run.name}"], check=False).returncode == 0

    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        return all(list(pool.map(train, open_runs)))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", required=True, type=pathlib.Path, help="folder of data and policies")
    parser.add_argument("--out", required=True, type=pathlib.Path, help="folder of the results")
    parser.add_argument("--spiketrain", help="the program; default: $SPIKETRAIN, or the one on PATH")
    parser.add_argument("--seeds", default=study_plan.SEEDS, type=int, help="train from seed 1 to this one")
    parser.add_argument("--tasks", default=",".join([*study_tasks.TASKS, *study_tasks.TASKS_OF_THE_PAPER]), help="tasks of study_tasks.py")
    parser.add_argument("--jobs", default=1, type=int, help="runs at the same time")
    parser.add_argument("--no_longer", action="store_true", help="do not play in contexts longer than that of the training")
    parser.add_argument("--parts", action="store_true", help="train the variants of `full`")
    parser.add_argument("--settings", action="store_true", help="train on the paper's four tasks with its settings")
    parser.add_argument("--field", action="store_true", help="train on the datasets of MuJoCo")
    parser.add_argument("--structured", action="store_true", help="train on tasks that a queue should not play")
    parser.add_argument("--sets", default="build/sets", type=pathlib.Path, help="folder of the datasets of MuJoCo")
    parser.add_argument("--only", help="the name of one run, such as cartpole-full-3")
    parser.add_argument("--smoke", action="store_true", help="tiny models and hardly any training: a test in seconds")
    arguments = parser.parse_args()
    work, tasks = arguments.work.resolve(), arguments.tasks.split(",")
    work.mkdir(parents=True, exist_ok=True)
    budget = study_plan.SMOKE if arguments.smoke else study_plan.Budget()
    study = Study(arguments.out.resolve(), budget)
    if arguments.only:
        run = run_named(arguments.only, tasks, arguments.seeds)
        workshop = Workshop(work, find_spiketrain(arguments.spiketrain), budget, arguments.sets.resolve(), not arguments.no_longer)
        study.add(run, workshop.carry_out(run, study.rate_of(run)))
        return 0
    command = [sys.executable, *sys.argv]
    stages = [study_plan.sweep_runs(tasks), study_plan.study_runs(tasks, arguments.seeds)]
    if arguments.parts:
        stages = [study_plan.part_runs(tasks, arguments.seeds)]
    if arguments.settings:
        stages = [study_plan.settings_runs()]
    if arguments.field:
        stages = [study_plan.field_runs()]
    if arguments.structured:
        stages = [study_plan.structured_sweep_runs(), study_plan.structured_runs()]
    return 0 if all(train_all(study, runs, command, arguments.jobs) for runs in stages) else 1


if __name__ == "__main__":
    sys.exit(main())
