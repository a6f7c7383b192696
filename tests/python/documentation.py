"""Runs the examples of a documentation page in the way a reader runs them."""

import os
import pathlib
import re
import subprocess

from serving import DEPLOY

DOCS = pathlib.Path(__file__).parents[2] / "docs"
PAGES_SERVER = "127.0.0.1:50051"
PAGES_GRPC_PORT = "50051"
PAGES_HTTP_PORT = "9464"


def run_examples(page, address):
    """Runs every Python example of docs/<page>, in order, against the server at `address`."""
    path = DOCS / page
    examples = re.findall(r"^```python\n(.*?)^```$", path.read_text(), re.MULTILINE | re.DOTALL)
    assert examples
    names = {}
    for example in examples:
        exec(compile(example.replace(PAGES_SERVER, address), path, "exec"), names)


class Shell:
    """Runs the commands of a page: the server in the background, everything else in the foreground.

    `directory` looks like a checkout after `make build`. Only the ports differ from the page: the server listens on
    free ports, and the other commands call these ports.
    """

    def __init__(self, directory):
        self._directory = directory
        self._server = None
        self._addresses = {}
        programs = directory / "build/release/bin"
        programs.mkdir(parents=True)
        (directory / "deploy").symlink_to(DEPLOY)
        self._write(programs / "make", "")
        free = "--listen=127.0.0.1:0 --http_listen=127.0.0.1:0"
        self._write(programs / "spikeserve", f'exec {os.environ["SPIKESERVE_PROGRAM"]} "$@" {free}')
        spikectl = os.environ["SPIKECTL_PROGRAM"]
        self._write(
            programs / "spikectl",
            f'case "$*" in *--server=*) exec {spikectl} "$@" ;; esac\nexec {spikectl} "$@" --server=$PAGES_SERVER',
        )
        self._write(programs / "spiketrain", f'exec {os.environ.get("SPIKETRAIN_PROGRAM", "false")} "$@"')
        self._environment = os.environ | {"PATH": f"{programs}:{os.environ['PATH']}"}

    @staticmethod
    def _write(path, text):
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stop()

    @property
    def server(self):
        """Returns the address of the server, or None before the page has started it."""
        return self._addresses.get(PAGES_GRPC_PORT)

    def run(self, page, edits=()):
        """Runs every `bash` block of docs/<page>, in order, and yields the output of each.

        `edits` are pairs of a text of the page and its replacement.
        """
        blocks = re.findall(r"^```bash\n(.*?)^```$", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL)
        assert blocks
        for block in blocks:
            for text, replacement in edits:
                block = block.replace(text, replacement)
            if block.startswith("spikeserve "):
                self._start(block)
            else:
                yield self._call(block)

    def _call(self, block):
        for port, address in self._addresses.items():
            block = block.replace(f":{port}", f":{address.rpartition(':')[2]}")
        finished = subprocess.run(
            ["bash", "-ec", block],
            cwd=self._directory,
            env=self._environment | {"PAGES_SERVER": self._addresses.get(PAGES_GRPC_PORT, "")},
            check=False,
            capture_output=True,
            text=True,
        )
        assert finished.returncode == 0, f"{block}\n{finished.stdout}\n{finished.stderr}"
        return finished.stdout

    def _start(self, command):
        self._stop()
        self._server = subprocess.Popen(
            ["bash", "-c", f"exec {command}"],
            cwd=self._directory,
            env=self._environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        for port in (PAGES_GRPC_PORT, PAGES_HTTP_PORT):
            self._addresses[port] = self._server.stdout.readline().split()[-1]

    def _stop(self):
        if self._server is None:
            return
        self._server.terminate()
        assert self._server.wait() == 0
        self._server.stdout.close()
        self._server = None
