"""Prints the table of lab/evidence/training-runs.md: what the three versions of the shipped policies return.

    python lab/recipes/integer_table.py

All figures are those that the policy files record: version 2 (8-bit weights) and version 3 (integer arithmetic) played the
same starts as version 1 (float32), from seed 2,000,000 on. Needs the package safetensors.
"""

import json
import pathlib

from safetensors import safe_open

POLICIES = pathlib.Path(__file__).parents[2] / "deploy/policies"
HEADER = ("policy", "starts", "float32", "int8", "integer", "difference, 95% interval", "spikes per decision", "KB")


def read(path):
    """Returns the record and the configuration of a policy file."""
    with safe_open(path, framework="np") as file:
        metadata = file.metadata()
    return json.loads(metadata["training"]), json.loads(metadata["config"])


def number(value, digits):
    """Formats a number without the sign of a rounded zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def row(folder):
    """Returns the cells of the policy of a folder."""
    files = [folder / version / "policy.safetensors" for version in "123"]
    _, (int8, _), (integer, config) = map(read, files)
    pair = integer["paired_returns"]
    digits = 2 if max(map(abs, pair["mean_returns"])) > 2 else 4
    returns = [pair["mean_returns"][0], int8["evaluation"]["mean_return"], pair["mean_returns"][1]]
    spikes = [pair["spikes_per_decision"][0], int8["evaluation"]["spikes_per_decision"], pair["spikes_per_decision"][1]]
    low, high = pair["difference_95_percent"]
    interval = f" ({number(low, digits)} to {number(high, digits)})" if low < high else ""
    return [
        f"`{folder.name}` (`{config['mode']}`, F = {config['ffn_size']})",
        str(pair["episodes"]),
        *(number(value, digits) for value in returns),
        number(pair["mean_difference"], digits) + interval,
        ", ".join(number(value, 1) for value in spikes),
        ", ".join(str(round(file.stat().st_size / 1000)) for file in files),
    ]


def main():
    lines = [HEADER, ["---", *["---:"] * (len(HEADER) - 1)]]
    lines += [row(policy) for policy in sorted(POLICIES.iterdir())]
    for line in lines:
        print("| " + " | ".join(line) + " |")


if __name__ == "__main__":
    main()
