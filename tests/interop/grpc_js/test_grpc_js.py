"""grpc-js, the implementation for Node.js."""

import functools
import pathlib

import pytest
from cases import *  # noqa: F403
from cases import check
from programs import INSTALLED, missing, require

CLIENT = pathlib.Path(__file__).parent / "client.js"
MODULES = INSTALLED / "grpc_js" / "node_modules"


@pytest.fixture(scope="module")
def client():
    node = require("node")
    if not MODULES.exists():
        missing(f"{MODULES}: expected the modules that `deploy/setup.sh` installs, found none")
    return functools.partial(check, [node, CLIENT], NODE_PATH=MODULES)
