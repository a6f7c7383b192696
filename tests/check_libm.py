"""Checks that nothing that decides calls functions of the C library whose last bits differ between processors.

Those are the functions that IEEE 754 does not round in one way, such as log and sin; core/math/portable.h replaces them. The
environments may call them, because they have to equal Gymnasium's on the same machine, which does. Random numbers of the C++
library pass too, but its distributions over real numbers call such functions or leave the bits open.
"""

import os
import re
import subprocess
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
DECIDING = ["core", "server"]
EXCEPT = "core/environment/"
ROUNDED_AS_THEY_LIKE = (
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf erfc exp exp2 expm1 hypot lgamma log log10 log1p log2 pow sin sinh "
    "tan tanh tgamma"
).split()
CALL = re.compile(
    r"\b(?:std::)(?P<call>" + "|".join(ROUNDED_AS_THEY_LIKE) + r")[fl]?\b(?!::)"
    r"|\busing std::(?P<using>" + "|".join(ROUNDED_AS_THEY_LIKE) + r");"
    r"|(?<![\w:.>])(?P<plain>" + "|".join(ROUNDED_AS_THEY_LIKE) + r")[fl]?\("
    r"|\b(?P<distribution>(?:normal|lognormal|exponential|gamma|uniform_real|weibull|student_t)_distribution)\b"
)
COMMENT = re.compile(r"//.*")


def sources():
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *DECIDING]
    names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    return [name for name in names if name.endswith((".cc", ".h")) and not name.startswith(EXCEPT)]


def main():
    complaints, files = [], sources()
    for name in files:
        with open(os.path.join(ROOT, name), encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                for match in CALL.finditer(COMMENT.sub("", line)):
                    complaints.append(f"{name}:{number}: {match.group().strip('(')} has other bits on other processors")
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_libm: {len(files)} files, {len(complaints)} complaints")
    sys.exit(1 if complaints or not files else 0)


if __name__ == "__main__":
    main()
