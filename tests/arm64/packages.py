"""Makes the arm64 packages of a finished build, installs them into a Debian for arm64 and plays CartPole with what they installed.

apt and the scripts of the packages run under qemu. Fails if a package is of another architecture or the return is below 500.0.
"""

import subprocess
import sys
import tempfile

import short

NAMES = ("spikeserve_*_arm64.deb", "spikeserve-tools_*_arm64.deb")


def make_packages():
    """Returns the files of the packages of the server and of its tools."""
    subprocess.run(["cpack", "-G", "DEB"], cwd=short.BUILD, check=True, stdout=subprocess.DEVNULL)
    return [next((short.BUILD / "packages").glob(name)) for name in NAMES]


def make_debian(target, *options):
    """Makes a Debian 12 for arm64 in a folder, or in a file that ends with .tar."""
    debian = ["--mode=root", "--variant=apt", "--architectures=arm64", "--skip=check/qemu"]
    subprocess.run([short.EMULATE, "mmdebstrap", "--quiet", *debian, "bookworm", target, *options], check=True)


def play_inside(root, user="root"):
    """Returns whether CartPole returns 500.0 with the programs and the policies of a root."""
    inside = [short.EMULATE, "chroot", f"--userspec={user}", root]
    run = [*inside, "/usr/bin/spikectl", "run", "--server={}", "--env=CartPole-v1", "--episodes=2", "--seed=3000000"]
    return short.play([*inside, "/usr/bin/spikeserve"], run, "/usr/share/spikeserve/policies")


def main():
    packages = make_packages()
    with tempfile.TemporaryDirectory() as folder:
        root = f"{folder}/root"
        copies = " ".join(f"/tmp/{package.name}" for package in packages)
        install = f'chroot "$1" apt-get install -y -qq --no-install-recommends {copies}'
        copy_in = f"--customize-hook=copy-in {' '.join(map(str, packages))} /tmp"
        make_debian(root, copy_in, f"--customize-hook={install}")
        return 0 if play_inside(root) else 1


if __name__ == "__main__":
    sys.exit(main())
