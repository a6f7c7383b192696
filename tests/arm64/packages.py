"""Makes the arm64 packages of a finished build, installs them into a Debian for arm64 and plays CartPole with what they installed.

Then makes the image of deploy/image of them, and plays with what it has. apt, the scripts of the packages, buildah and what it
runs are emulated by qemu. Fails if a package is of another architecture, the image has 120 MB or more, or the return is below
500.0.
"""

import pathlib
import shutil
import subprocess
import sys
import tempfile

import short

MOST_BYTES = 120e6  # of the image, as test_image.py
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


def make_image(folder, base, packages):
    """Returns the folder of the files of the image of deploy/image."""
    storage = ["--storage-driver", "vfs", "--root", folder / "root", "--runroot", folder / "run"]

    def buildah(*arguments):
        command = [short.EMULATE, "buildah", *storage, *arguments]
        return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.strip()

    container = buildah("from", "--arch", "arm64", "scratch")
    buildah("add", "-q", container, base, "/")
    buildah("commit", "-q", "--rm", container, "localhost/base")
    context = folder / "context"
    shutil.copytree(short.ROOT / "deploy/image", context / "deploy/image")
    (context / "dist").mkdir()
    for package in packages:
        shutil.copy(package, context / "dist")
    buildah(
        *("bud", "--arch", "arm64", "--isolation", "chroot", "-t", "localhost/spikeserve"),
        *("--build-arg", "BASE=localhost/base", "--build-arg", "SOURCE=packages"),
        *("-f", context / "deploy/image/Dockerfile", context),
    )
    return pathlib.Path(buildah("mount", buildah("from", "--arch", "arm64", "localhost/spikeserve")))


def installed_plays(packages):
    """Returns whether CartPole is solved in a Debian with the packages."""
    with tempfile.TemporaryDirectory() as folder:
        root = f"{folder}/root"
        copies = " ".join(f"/tmp/{package.name}" for package in packages)
        install = f'chroot "$1" apt-get install -y -qq --no-install-recommends {copies}'
        copy_in = f"--customize-hook=copy-in {' '.join(map(str, packages))} /tmp"
        make_debian(root, copy_in, f"--customize-hook={install}")
        return play_inside(root)


def image_plays(packages):
    """Returns whether CartPole is solved in the image, and that is small."""
    with tempfile.TemporaryDirectory() as folder:
        base = pathlib.Path(folder, "base.tar")
        make_debian(base)
        files = make_image(pathlib.Path(folder), base, packages)
        size = sum(path.lstat().st_size for path in files.rglob("*") if path.is_file() and not path.is_symlink())
        print(f"image: {size / 1e6:.1f} MB", flush=True)
        return size < MOST_BYTES and play_inside(files, "10001:10001")


def main():
    packages = make_packages()
    return 0 if installed_plays(packages) and image_plays(packages) else 1


if __name__ == "__main__":
    sys.exit(main())
