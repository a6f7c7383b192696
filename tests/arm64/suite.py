"""Runs the tests of the arm64 build with ctest and qemu, all but those that say nothing of arm64, and names these.

usage: suite.py [CTEST_ARGUMENT...]
"""

import subprocess
import sys

import short

# Why tests are left out, with regular expressions of their whole names.
LEFT_OUT = {
    "boots a Linux for this machine's processor, which cannot run the arm64 server": ["clock_steps", "power_cut"],
    "compiles or installs for this machine; packages.py and wheel.py do so for arm64": [
        *("test_install", "test_release", "test_torch_wheel"),
    ],
    "mounts an overlay, or starts programs without the environment by which qemu finds their libraries": [
        *("test_chart", "test_compose"),
    ],
    "measures memory or processor time, which are those of qemu": [
        *("soak", "test_attacks", "test_call_costs", "test_connections"),
    ],
    "reads which packages of this machine a program links": ["test_library_cves"],
    "starts no program of the build": [
        *("model_.*", "test_lineage"),
        *("test_python_package", "test_ros_logic", "test_site"),
    ],
}


def main(arguments):
    for reason, names in LEFT_OUT.items():
        print(f"left out, because it {reason}: {' '.join(names)}", flush=True)
    left_out = "|".join(name for names in LEFT_OUT.values() for name in names)
    ctest = ["ctest", "--preset", "arm64", "--exclude-regex", f"^({left_out})$", *arguments]
    return subprocess.run([short.EMULATE, *ctest], cwd=short.ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
