"""Makes the arm64 packages of a finished build, installs them into a Debian for arm64 and plays CartPole with what they installed.

apt and the scripts of the packages run under qemu. Fails if a package is of another architecture or the return is below 500.0.
"""

import pathlib
import subprocess
import sys
import tempfile

import short

SERVER, TOOLS = "spikeserve_*_arm64.deb", "spikeserve-tools_*_arm64.deb"


def main():
    subprocess.run(["cpack", "-G", "DEB"], cwd=short.BUILD, check=True, stdout=subprocess.DEVNULL)
    packages = [next((short.BUILD / "packages").glob(name)) for name in (SERVER, TOOLS)]
    with tempfile.TemporaryDirectory() as folder:
        root = pathlib.Path(folder, "root")
        copies = " ".join(f"/tmp/{package.name}" for package in packages)
        install = f'chroot "$1" apt-get install -y -qq --no-install-recommends {copies}'
        debian = ["--mode=root", "--variant=apt", "--architectures=arm64", "--skip=check/qemu", "bookworm", root]
        hooks = [f"--customize-hook=copy-in {' '.join(map(str, packages))} /tmp", f"--customize-hook={install}"]
        subprocess.run([short.EMULATE, "mmdebstrap", "--quiet", *debian, *hooks], check=True)
        inside = [short.EMULATE, "chroot", root]
        run = [*inside, "spikectl", "run", "--server={}", "--env=CartPole-v1", "--episodes=2", "--seed=3000000"]
        return 0 if short.play([*inside, "spikeserve"], run, "/usr/share/spikeserve/policies") else 1


if __name__ == "__main__":
    sys.exit(main())
