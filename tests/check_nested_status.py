"""Checks that no function returns absl::StatusOr<absl::Status>, into which an error converts as a value: `return
reply.status();` is then a success whose value nobody expects to be the error of the call itself. Return the inner status by
an argument.
"""

import os
import re
import subprocess
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
NESTED = re.compile(r"StatusOr<\s*(?:const\s+)?(?:absl::)?Status\s*>")


def main():
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.cc", "*.h"]
    paths = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    failed = False
    for path in paths:
        if not os.path.exists(os.path.join(ROOT, path)):
            continue
        with open(os.path.join(ROOT, path), encoding="utf-8") as source:
            for number, line in enumerate(source, 1):
                if NESTED.search(line):
                    failed = True
                    print(f"{path}:{number}: expected no status within a StatusOr, received {line.strip()}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
