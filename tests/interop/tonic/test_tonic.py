"""tonic, the implementation for Rust. Builds its client first, which takes minutes."""

import functools
import pathlib
import subprocess

import pytest
from cases import *  # noqa: F403
from cases import check
from programs import INSTALLED, require

CRATE = pathlib.Path(__file__).parent
TARGET = INSTALLED / "tonic"


@pytest.fixture(scope="module")
def client():
    """Builds the crate with the versions of Cargo.lock."""
    cargo = require("cargo")  # 1.88 or later; Debian 12 has it as cargo-web
    subprocess.run(
        [cargo, "build", "--locked", "--quiet", f"--target-dir={TARGET}"], cwd=CRATE, check=True
    )
    return functools.partial(check, [TARGET / "debug" / "interop"])
