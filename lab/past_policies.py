"""Brings back policies that were shipped once, from the history of the repository (past_policies.md lists them).

    python lab/past_policies.py NAME VERSION    # prints the path of the file

Needs a checkout with its history.
"""

import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[1]
COMMIT = re.search(r"commit `([0-9a-f]{40})`", pathlib.Path(__file__).with_suffix(".md").read_text())[1]


def past_policy(name, version):
    """Returns the path of a policy file, as POLICIES/NAME/VERSION/policy.safetensors."""
    path = ROOT / "build/lab/policies" / name / str(version) / "policy.safetensors"
    if not path.is_file():
        show = ["git", "-C", ROOT, "show", f"{COMMIT}:deploy/policies/{name}/{version}/policy.safetensors"]
        content = subprocess.run(show, check=True, capture_output=True).stdout
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_bytes(content)
        partial.rename(path)
    return path


if __name__ == "__main__":
    print(past_policy(*sys.argv[1:]))
