"""Checks sources with clang-tidy, as .clang-tidy configures it, and fails on any complaint.

usage: check_clang_tidy.py COMPILE_COMMANDS_JSON FOLDER...
"""

import concurrent.futures
import json
import os
import shlex
import subprocess
import sys


def uses_torch(entry):
    """Returns whether a source file sees libtorch, whose headers clang refuses."""
    return "/torch/" in entry["command"]


def check(entry):
    """Returns clang-tidy's complaints about one source file, or an empty string."""
    arguments = shlex.split(entry["command"])
    start = next(i for i, a in enumerate(arguments) if a.endswith("++"))
    # clang does not know the tree passes that GCC's flags of this form name.
    flags = [f for f in arguments[start + 1 :] if not f.startswith("-fno-tree-")]
    command = ["clang-tidy", "--quiet", entry["file"], "--", *flags]
    result = subprocess.run(command, cwd=entry["directory"], capture_output=True, text=True)
    return (result.stdout or result.stderr) if result.returncode else ""


def main():
    commands, folders = sys.argv[1], sys.argv[2:]
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    prefixes = tuple(os.path.join(root, folder) + os.sep for folder in folders)
    with open(commands, encoding="utf-8") as file:
        entries = [e for e in json.load(file) if e["file"].startswith(prefixes) and not uses_torch(e)]
    if not entries:
        sys.exit("check_clang_tidy: no sources below " + ", ".join(folders))
    refused = 0
    with concurrent.futures.ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for complaint in pool.map(check, entries):
            if complaint:
                refused += 1
                print(complaint, file=sys.stderr, flush=True)
    print(f"check_clang_tidy: {len(entries)} files, {refused} with complaints")
    sys.exit(1 if refused else 0)


if __name__ == "__main__":
    main()
