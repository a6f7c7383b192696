"""Runs the programs of examples/ in Node.js and Go."""

import os
import pathlib

from programs import INSTALLED, missing, require, run

EXAMPLES = pathlib.Path(__file__).parents[3] / "examples"
MODULES = INSTALLED / "grpc_js" / "node_modules"
COMPILE_SECONDS = 300


def test_node_js(server):
    if not MODULES.exists():
        missing(f"{MODULES}: expected the modules that `deploy/setup.sh` installs, found none")
    finished = run(require("node"), EXAMPLES / "call.js", server.grpc, env=os.environ | {"NODE_PATH": str(MODULES)})
    assert (finished.returncode, finished.stdout) == (0, "return 500\n"), finished.stderr


def test_go(server, tmp_path):
    environment = os.environ | {"GOCACHE": str(tmp_path / "cache"), "GOTOOLCHAIN": "local"}
    finished = run(require("go"), "run", EXAMPLES / "call.go", server.http, env=environment, timeout=COMPILE_SECONDS)
    assert (finished.returncode, finished.stdout) == (0, "return 500\n"), finished.stderr
