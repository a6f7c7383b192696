"""What the tables of the study have in common."""

import study_plan


def row(cells):
    return f"| {' | '.join(cells)} |"


def joined(tables):
    """Returns the text of tables, each of which is a sequence of lines; those without a line are left out."""
    texts = ("\n".join(table) for table in tables)
    return "\n\n".join(text for text in texts if text)


def score(result):
    task = study_plan.TASKS[result["task"]]
    return 100 * (result["mean_return"] - task.chance) / (task.expert_return - task.chance)
