"""Checks sources with clang, and fails on any complaint.

usage: check_clang.py tidy|threads COMPILE_COMMANDS_JSON FOLDER...

tidy: with clang-tidy, as .clang-tidy configures it. threads: their thread annotations, which g++ does not know.
"""

import concurrent.futures
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading


def tidy(entry, flags, _):
    # clang knows neither this warning nor the tree passes that GCC's flags of this form name.
    flags = [f for f in flags if not f.startswith("-fno-tree-") and f != "-Wno-subobject-linkage"]
    return ["clang-tidy", "--quiet", entry["file"], "--", *flags]


def sources(entry, root):
    """Returns an entry for each source of a unit of sources (cmake/SpikeserveTargets.cmake), or the entry itself."""
    if not re.search(r"_unit_\d+\.cc$", entry["file"]):
        return [entry]
    with open(entry["file"], encoding="utf-8") as unit:
        files = [os.path.join(root, line.split('"')[1]) for line in unit if line.startswith("#include")]
    return [{**entry, "file": file, "command": entry["command"].replace(entry["file"], file)} for file in files]


def threads(_, flags, scratch):
    output = flags.index("-o")
    kept = [f for f in flags[:output] + flags[output + 2 :] if f not in ("-Werror", "-MD")]
    kept += ["-Wthread-safety", "-Werror=thread-safety", "-Wno-unknown-warning-option"]
    if not shutil.which("ccache"):
        return ["clang++", *kept, "-fsyntax-only"]
    # It remembers what has not changed since the last run, but only of whole compilations.
    return ["ccache", "clang++", *kept, "-O0", "-o", f"{scratch}/{threading.get_ident()}.o"]


def main():
    name, commands, *folders = sys.argv[1:]
    command_of = {"tidy": tidy, "threads": threads}[name]
    root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    with open(commands, encoding="utf-8") as file:
        # Without sources that see libtorch, whose headers clang refuses.
        entries = [e for e in json.load(file) if "/torch/" not in e["command"]]
    if name == "tidy":  # which complains about the file that it is given, not about what that includes
        entries = [source for entry in entries for source in sources(entry, root)]
    prefixes = tuple(os.path.join(root, folder) + os.sep for folder in folders)
    # A unit of several components counts if it has one below these folders.
    entries = [e for e in entries if any(source["file"].startswith(prefixes) for source in sources(e, root))]
    if not entries:
        sys.exit(f"check_clang {name}: no sources below " + ", ".join(folders))

    def check(entry):
        """Returns the complaints about one source file, or an empty string."""
        arguments = shlex.split(entry["command"])
        compiler = next(i for i, a in enumerate(arguments) if a.endswith("++"))
        command = command_of(entry, arguments[compiler + 1 :], scratch)
        result = subprocess.run(command, cwd=entry["directory"], capture_output=True, text=True)
        return (result.stdout or result.stderr) if result.returncode else ""

    refused = 0
    with tempfile.TemporaryDirectory() as scratch, concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        for complaint in pool.map(check, entries):
            if complaint:
                refused += 1
                print(complaint, file=sys.stderr, flush=True)
    print(f"check_clang {name}: {len(entries)} files, {refused} with complaints")
    sys.exit(1 if refused else 0)


if __name__ == "__main__":
    main()
