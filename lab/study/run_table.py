"""Reads and writes the tables of runs: a CSV file for each group of tasks, with a row for each run.

    pandas.read_csv("lab/study/runs/study.csv")

A result is a dict of numbers, texts and dicts of numbers. The column of `{"integer": {"starts": 5}}` is `integer.starts`. A run
that lacks a value has an empty cell. Several processes may add rows to a table at the same time.
"""

import contextlib
import csv
import fcntl
import os
import pathlib

TEXTS = ("task", "arm", "learning_rate", "training")  # columns that are no numbers, which every run has
DIGEST = "sha256"
# What stands beside an energy: figures of the same file on the same starts.
OF_ONE_FILE = (
    *(DIGEST, "first_start", "starts", "mean_return", "spikes_per_decision", "microseconds_per_decision"),
    *("int_sram_nanojoules_per_decision", "int_nanojoules_per_decision"),
)


def mixed_figures(result):
    """Yields what is wrong with the energies of a result: each belongs to one file, whose return stands beside it."""
    parts = {"": result} | {name: part for name, part in result.items() if isinstance(part, dict)}
    for name, part in parts.items():
        if not any("joules" in key for key in part):
            continue
        missing = [key for key in OF_ONE_FILE if key not in part]
        if missing:
            yield f"{name}: expected {', '.join(missing)} beside an energy, received none".removeprefix(": ")
        elif (part["first_start"], part["starts"]) != (result["first_start"], result["starts"]):
            yield f"{name}: expected the starts of the run, received others"


def served(result):
    """Returns the figures of the policy as it is served, in integers, or of the only file that was played."""
    return result.get("integer", result)


def name_of(result, group):
    """Returns the name of the run with a result: `Run.name` of study_plan.py."""
    rate = [f"rate{result['learning_rate']}"] if group == "sweep" else []
    return "-".join([result["task"], result["arm"], *rate, str(result["seed"])])


def flat(result):
    row = {}
    for name, value in result.items():
        if isinstance(value, dict):
            row |= {f"{name}.{key}": inner for key, inner in value.items()}
        else:
            row[name] = value
    return row


def number(text):
    try:
        return int(text)
    except ValueError:
        return float(text)


def nested(row):
    result = {}
    for column, text in row.items():
        name, _, key = column.partition(".")
        if column in TEXTS:
            result[column] = text
        elif text:
            value = text if DIGEST in (name, key) else number(text)
            (result.setdefault(name, {}) if key else result)[key or name] = value
    return result


def read_results(folder, group="study"):
    """Returns the results of a group in the order of their names; none if it has no table."""
    path = pathlib.Path(folder) / f"{group}.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [nested(row) for row in csv.DictReader(file)]


def write_results(folder, group, results):
    """Writes the table of a group, which appears when it is complete."""
    rows = [flat(result) for result in sorted(results, key=lambda result: name_of(result, group))]
    columns = list(dict.fromkeys(column for row in rows for column in row))
    columns.sort(key=lambda column: "." in column)  # those of dicts last
    path = pathlib.Path(folder) / f"{group}.csv"
    partial = path.with_suffix(f".{os.getpid()}.partial")
    with partial.open("w", newline="") as file:
        table = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    partial.rename(path)


def add_result(folder, group, result):
    """Adds a result to the table of its group, or replaces the one of the same run."""
    pathlib.Path(folder).mkdir(parents=True, exist_ok=True)
    with locked(folder):
        name = name_of(result, group)
        others = [other for other in read_results(folder, group) if name_of(other, group) != name]
        write_results(folder, group, [*others, result])


@contextlib.contextmanager
def locked(folder):
    """Waits until no other process writes a table of the folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
