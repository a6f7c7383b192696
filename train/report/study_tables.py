"""What the tables of the study have in common."""

import json
import pathlib

import study_plan

ALPHA = 0.05


def read_runs(folder):
    """Returns all results of a folder by task and arm, and each of these by seed."""
    runs = {}
    for result in map(json.loads, map(pathlib.Path.read_text, sorted(folder.glob("*.json")))):
        runs.setdefault((result["task"], result["arm"]), {})[result["seed"]] = result
    return runs


def row(cells):
    return f"| {' | '.join(cells)} |"


def joined(tables):
    """Returns the text of tables, each of which is a sequence of lines; those without a line are left out."""
    texts = ("\n".join(table) for table in tables)
    return "\n\n".join(text for text in texts if text)


def score(result):
    task = (study_plan.TASKS | study_plan.FIELD_TASKS)[result["task"]]
    return 100 * (result["mean_return"] - task.chance) / (task.expert_return - task.chance)
