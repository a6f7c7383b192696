"""Makes the image of deploy/image for arm64 from the packages of a finished build, and plays CartPole with what it has.

buildah and what it runs are emulated by qemu. Fails if the image has 120 MB or more, or the return is below 500.0.
"""

import pathlib
import shutil
import subprocess
import sys
import tempfile

import packages
import short

MOST_BYTES = 120e6  # as test_image.py


def make_image(folder, base):
    """Returns the folder of the image's files."""
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
    for package in packages.make_packages():
        shutil.copy(package, context / "dist")
    buildah(
        *("bud", "--arch", "arm64", "--isolation", "chroot", "-t", "localhost/spikeserve"),
        *("--build-arg", "BASE=localhost/base", "--build-arg", "SOURCE=packages"),
        *("-f", context / "deploy/image/Dockerfile", context),
    )
    return pathlib.Path(buildah("mount", buildah("from", "--arch", "arm64", "localhost/spikeserve")))


def main():
    with tempfile.TemporaryDirectory() as folder:
        base = pathlib.Path(folder, "base.tar")
        packages.make_debian(base)
        files = make_image(pathlib.Path(folder), base)
        size = sum(path.lstat().st_size for path in files.rglob("*") if path.is_file() and not path.is_symlink())
        print(f"image: {size / 1e6:.1f} MB", flush=True)
        return 0 if size < MOST_BYTES and packages.play_inside(files, "10001:10001") else 1


if __name__ == "__main__":
    sys.exit(main())
