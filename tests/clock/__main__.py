"""Runs tests/clock/steps.py on a machine whose clock can be set: a Linux kernel that runs as a program of the user.

usage: python -m tests.clock

The machine is user-mode Linux with the files of this one. Its kernel has a clock of its own, so timeouts of system calls
meet real steps, which a library that fakes the time cannot show. Needs the variable SPIKESERVE_PROGRAM and Debian's
package user-mode-linux. Exits with status 77 if the machine cannot be started.
"""

import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
SKIPPED = 77
SECONDS = 540


def main():
    linux = shutil.which("linux.uml")
    if linux is None:
        print("clock: expected linux.uml of the package user-mode-linux, received none")
        sys.exit(SKIPPED)
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(linux, "mem=1G", "rootfstype=hostfs", "rootflags=/", "ro", "quiet", f"uml_dir={folder}"),
            *("con=null", "con0=null,fd:1", f"init={pathlib.Path(__file__).parent / 'init.sh'}"),
            *(f"CLOCK_ROOT={ROOT}", f"CLOCK_PYTHON={sys.executable}"),
            f"SPIKESERVE_PROGRAM={os.environ['SPIKESERVE_PROGRAM']}",
        ]
        # The kernel's own lines go to the same place as those of the test.
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL
        ) as machine:
            try:
                output = machine.communicate(timeout=SECONDS)[0].decode(errors="replace")
            except subprocess.TimeoutExpired:
                machine.kill()
                sys.exit(f"clock: the machine did not end within {SECONDS} s")
    print(output)
    if "clock: began" not in output:
        sys.exit(SKIPPED)
    sys.exit(0 if "clock: ended with status 0" in output else 1)


if __name__ == "__main__":
    main()
