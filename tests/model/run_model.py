"""Checks the models of this folder with SPIN: the protocol holds, and it fails without each of its parts.

usage: run_model.py [MODEL [VARIANT]]

Without VARIANT, every state of MODEL (a file of this folder; all of them without MODEL) is searched, and none may break an
assertion. With it, such as NO_FENCE, the search must find an execution that breaks one; its end is
printed.
"""

import pathlib
import re
import subprocess
import sys
import tempfile

FOLDER = pathlib.Path(__file__).parent


def run(*command, cwd):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{command[0]}: status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def check(model, variant):
    if variant is not None and f"-D{variant} " not in model.read_text():
        sys.exit(f"VARIANT: expected one that {model.name} describes, received {variant}")
    with tempfile.TemporaryDirectory() as folder:
        defines = [f"-D{variant}"] if variant else []
        run("spin", *defines, "-a", model, cwd=folder)
        run("cc", "-O2", "-w", "-DSAFETY", "-DCOLLAPSE", "-DVECTORSZ=2048", "-o", "pan", "pan.c", cwd=folder)
        # -E: processes may wait for ever, because the bounds of the model end.
        report = run("./pan", "-E", "-m1000000", cwd=folder)
        trail = run("spin", *defines, "-k", f"{model.name}.trail", "-p", model, cwd=folder) if variant else ""
    errors = int(re.search(r"errors: (\d+)", report)[1])
    states = re.search(r"(\S+) states, stored", report)[1]
    if "max search depth too small" in report:
        sys.exit(f"the search was cut off\n{report}")
    if variant is None:
        if errors > 0 or "assertion violated" in report:
            sys.exit(f"{model.name}: expected no error, received {errors}\n{report}")
        print(f"{model.name}: every one of {states} states keeps the assertions")
    else:
        if "assertion violated" not in report:
            sys.exit(f"expected that {variant} breaks an assertion, received none in {states} states\n{report}")
        print(*trail.splitlines()[-40:], sep="\n")
        print(f"{model.name}: {variant} breaks an assertion, as it should")


def main():
    name = sys.argv[1] if len(sys.argv) > 1 else "*"
    models = sorted(FOLDER.glob(f"{name}.pml"))
    if not models:
        sys.exit(f"MODEL: expected one of {[path.stem for path in sorted(FOLDER.glob('*.pml'))]}, received {name}")
    for model in models:
        check(model, sys.argv[2] if len(sys.argv) > 2 else None)


if __name__ == "__main__":
    main()
