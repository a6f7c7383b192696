"""The cases that the clients in other languages implement, each as one run of a program."""

import contextlib
import pathlib
import shutil

from contract import PROTO
from programs import run
from serving import SHIPPED_POLICIES, running_server

NAMES = [
    "empty_unary",
    "large_unary",
    "ping_pong",
    "half_close",
    "empty_stream",
    "cancel_after_begin",
    "cancel_after_first_response",
    "timeout",
    "metadata",
    "unimplemented",
    "compression",
    "concurrent",
    "health",
]
CORE = ["empty_unary", "large_unary", "ping_pong", "unimplemented"]  # of every transport


def check(client, case, address, *files, **environment):
    """Runs a case: `client`, a command, with the case, the address, the folder of .proto files and `files`."""
    finished = run(
        "env", *(f"{k}={v}" for k, v in environment.items()), *client, case, address, PROTO, *files
    )
    assert finished.returncode == 0, finished.stdout + finished.stderr


@contextlib.contextmanager
def odd_server(path: pathlib.Path):
    """Starts a server whose folder has an odd name. Yields it and the start of its error messages."""
    policies = path / "π ☃ 100%\n" / "policies"
    shutil.copytree(SHIPPED_POLICIES / "cartpole", policies / "cartpole")
    with running_server(policies=policies) as started:
        yield started, f"{policies}/cartpole/9/policy.safetensors"
