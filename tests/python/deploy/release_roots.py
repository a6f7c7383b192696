"""An empty Debian 12, for tests that install what a release publishes."""

import os
import pathlib
import shutil

from serving import run

ROOT = pathlib.Path(__file__).parents[3]
BUILD = pathlib.Path(os.environ["SPIKESERVE_BUILD_DIR"])


def bare_root():
    """Returns a root with Debian 12 and nothing else, which is made once for a build folder."""
    root = BUILD / "tests/bare-root"
    if not (root / "etc/debian_version").exists():
        new = root.with_suffix(".new")
        shutil.rmtree(new, ignore_errors=True)
        run("debootstrap", "--variant=minbase", "bookworm", new)
        new.rename(root)
    return root
