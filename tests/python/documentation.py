"""Runs the examples of a documentation page in the way a reader runs them."""

import os
import pathlib
import re
import subprocess
import sys

from serving import DEPLOY, run

DOCS = pathlib.Path(__file__).parents[2] / "docs"
PAGES_SERVER = "127.0.0.1:50051"
PAGES_GRPC_PORT = "50051"
PAGES_HTTP_PORT = "9464"
PAGES_HTTP = f"127.0.0.1:{PAGES_HTTP_PORT}"


def page_of(name):
    """Returns the path of the page of docs/ with that name, on whatever shelf it stands."""
    (path,) = DOCS.rglob(name)
    return path


def python_blocks(page):
    """Returns the Python blocks of a page: (name of the file that the text before it names, or None; text)."""
    text = page_of(page).read_text()
    blocks, end = [], 0
    for block in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        named = re.findall(r"^`(\w+\.py)`|\s`(\w+\.py)` (?:is|stands|writes)", text[end : block.start()], re.MULTILINE)
        end = block.end()
        if block[1] == "python":
            blocks.append((next(filter(None, named[-1])) if named else None, block[2]))
    return blocks


def files_of(page):
    """Returns the files that a page prints, by name."""
    return {name: text for name, text in python_blocks(page) if name}


def run_examples(page, address, http=PAGES_HTTP):
    """Runs every Python example of a page that is not a file, in order.

    The server is at `address` for gRPC, and at `http`.
    """
    path = page_of(page)
    examples = [text for name, text in python_blocks(page) if name is None]
    assert examples
    names = {}
    for example in examples:
        example = example.replace(PAGES_SERVER, address).replace(PAGES_HTTP, http)
        exec(compile(example, path, "exec"), names)


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
        self._write(programs / "python", f'exec {sys.executable} "$@"')
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
        """Runs every `bash` block of a page, in order, and yields the output of each.

        `edits` are pairs of a text of the page and its replacement.
        """
        blocks = re.findall(r"^```bash\n(.*?)^```$", page_of(page).read_text(), re.MULTILINE | re.DOTALL)
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
        environment = self._environment | {"PAGES_SERVER": self._addresses.get(PAGES_GRPC_PORT, "")}
        return run("bash", "-ec", block, cwd=self._directory, env=environment).stdout

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
