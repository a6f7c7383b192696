"""Checks claims.pml with SPIN: the protocol holds, and it fails without each of its parts.

usage: run_model.py [VARIANT]

Without VARIANT, every state is searched, and none may break an assertion. With it, such as NO_FENCE, the search must find
an execution that breaks one; its end is printed.
"""

import pathlib
import re
import subprocess
import sys
import tempfile

MODEL = pathlib.Path(__file__).parent / "claims.pml"


def run(*command, cwd):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{command[0]}: status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def main():
    variant = sys.argv[1] if len(sys.argv) > 1 else None
    if variant is not None and f"-D{variant} " not in MODEL.read_text():
        sys.exit(f"VARIANT: expected one that {MODEL.name} describes, received {variant}")
    with tempfile.TemporaryDirectory() as folder:
        defines = [f"-D{variant}"] if variant else []
        run("spin", *defines, "-a", MODEL, cwd=folder)
        run("cc", "-O2", "-w", "-DSAFETY", "-DCOLLAPSE", "-DVECTORSZ=2048", "-o", "pan", "pan.c", cwd=folder)
        # -E: processes may wait for ever, because the bounds of the model end.
        report = run("./pan", "-E", "-m1000000", cwd=folder)
        trail = run("spin", *defines, "-k", "claims.pml.trail", "-p", MODEL, cwd=folder) if variant else ""
    errors = int(re.search(r"errors: (\d+)", report)[1])
    states = re.search(r"(\S+) states, stored", report)[1]
    if "max search depth too small" in report:
        sys.exit(f"the search was cut off\n{report}")
    if variant is None:
        if errors > 0 or "assertion violated" in report:
            sys.exit(f"expected no error, received {errors}\n{report}")
        print(f"every one of {states} states keeps the assertions")
    else:
        if "assertion violated" not in report:
            sys.exit(f"expected that {variant} breaks an assertion, received none in {states} states\n{report}")
        print(*trail.splitlines()[-40:], sep="\n")
        print(f"{variant} breaks an assertion, as it should")


if __name__ == "__main__":
    main()
