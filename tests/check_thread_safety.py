"""Checks the thread annotations of a build with clang's -Wthread-safety, which g++ does not know.

usage: check_thread_safety.py COMPILE_COMMANDS_JSON FOLDER...
"""

import concurrent.futures
import json
import os
import shlex
import subprocess
import sys


def uses_torch(entry):
    """Whether a source file sees libtorch, whose headers clang refuses."""
    return "/torch/" in entry["command"]


def check(entry):
    """Returns clang's complaints about one source file, or an empty string."""
    arguments = shlex.split(entry["command"])
    start = next(i for i, a in enumerate(arguments) if a.endswith("g++"))
    output = arguments.index("-o")
    flags = arguments[start + 1 : output] + arguments[output + 2 :]
    command = ["clang++", "-fsyntax-only", "-Wthread-safety", "-Werror=thread-safety", "-Wno-unknown-warning-option"]
    command += [f for f in flags if f not in ("-Werror", "-MD")]
    result = subprocess.run(command, cwd=entry["directory"], capture_output=True, text=True)
    return result.stderr if result.returncode else ""


def main():
    commands, folders = sys.argv[1], sys.argv[2:]
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    prefixes = tuple(os.path.join(root, folder) + os.sep for folder in folders)
    with open(commands, encoding="utf-8") as file:
        entries = [e for e in json.load(file) if e["file"].startswith(prefixes) and not uses_torch(e)]
    if not entries:
        sys.exit("check_thread_safety: no sources below " + ", ".join(folders))
    with concurrent.futures.ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        complaints = [c for c in pool.map(check, entries) if c]
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_thread_safety: {len(entries)} files, {len(complaints)} with complaints")
    sys.exit(1 if complaints else 0)


if __name__ == "__main__":
    main()
