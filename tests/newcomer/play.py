"""Plays a newcomer who walks through all pages of docs/, one after the other, and types what they print.

usage: play.py [PAGE...]

Started by run.sh, in a root and a network of its own, in the root of a checkout after `make build`. Of each page it
runs the blocks in order:

  bash, sh   in one shell for each page. A block that starts a program which does not end (SERVERS) runs as in a second
             terminal, until the page or another such block begins.
  python     in one Python for each page, or as the file that the text in front of the block names.
  cmake, cpp as the file that the text in front of the block names, if it names one.

Blocks without a language are output or take too long, and are not run. Stops at the first block that fails.
"""

import pathlib
import re
import socket
import subprocess
import sys
import tempfile
import time

DOCS = pathlib.Path(__file__).parents[2] / "docs"
# In the order of reading.
PAGES = (
    "your-robot.md",
    "python.md",
    "imitation.md",
    "cpp.md",
    "triton.md",
    "grpc-web.md",
    "guides/policies.md",
    "recording.md",
    "corrections.md",
    "explain.md",
    "status-page.md",
    "watching.md",
    "security.md",
    "signing.md",
    "fleet.md",
    "training.md",
    "wiring.md",
)
# Pages that a newcomer reads only. test_chips.py runs the examples of chips.md.
WITHOUT_COMMANDS = {
    *("architecture.md", "chips.md", "compose.md", "energy.md", "image.md", "learning.md", "limits.md"),
    *("README.md", "cost.md", "distance.md", "durability.md", "tracing.md", "beats.md", "how-far.md", "integer.md"),
    *("kubernetes.md", "openpi.md", "flags.md", "metrics.md", "errors.md", "files.md", "glossary.md"),
    *("packages.md", "paper.md", "performance.md", "playground.md", "robots.md", "robots-data.md", "ros.md", "site.md"),
    *("threat-model.md", "upgrades.md"),
}
SERVERS = ("spikeserve ", "build/release/bin/spikeserve ", "prometheus ")
# The training that a page prints takes hours; that the commands work shows after a few steps.
EDITS = {
    "training.md": [("--resume", "--resume --iterations=2"), ("--episodes=1000", "--episodes=2")],
    "recording.md": [("--iterations=300", "--iterations=2")],
    "imitation.md": [
        ("--expert reacher:reach", "--expert reacher:reach --steps=3000 --iterations=20 --rounds=0 --silence= --episodes=4"),
    ],
    # These pages expect the programs in the PATH.
    "grpc-web.md": [("spikeserve --policies", "export PATH=$PWD/build/release/bin:$PATH\nspikeserve --policies")],
    "security.md": [("openssl req -x509", "export PATH=$PWD/build/release/bin:$PATH\nopenssl req -x509")],
}
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE_NAME = re.compile(r"(?:^|\. )`([\w.]+\.(?:py|cc|txt))`(?::| (?:is|opens|stands|writes)\b)", re.MULTILINE)
DEADLINE_SECONDS = 60
# Runs each file whose path arrives on standard input in one namespace, and answers when it has ended.
PYTHON_DRIVER = """
import sys
names = {"__name__": "__main__"}
for line in sys.stdin:
    path = line.strip()
    exec(compile(open(path).read(), path, "exec"), names)
    print("__ended__", flush=True)
"""


def page_of(name):
    """Returns the path of the page of docs/ with that name, on whatever shelf it stands."""
    (path,) = DOCS.rglob(name)
    return path


class Failure(Exception):
    """A block of a page failed."""


class Terminal:
    """The shells and the Python of one page."""

    def __init__(self):
        self._shell = subprocess.Popen(
            ["bash", "-e"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._scratch = tempfile.TemporaryDirectory()
        self._python = None
        self._servers = {}  # by port

    def close(self):
        for port in list(self._servers):
            self._stop_server(port)
        if self._python is not None:
            self._python.stdin.close()
            self._python.wait()
        self._shell.stdin.close()
        self._shell.wait()
        self._scratch.cleanup()

    def run(self, commands):
        """Runs commands and returns what they print."""
        return self._ask(self._shell, f"{commands}\necho; echo __ended__\n")

    def start(self, command):
        """Starts a program in the background, where the shell is now, and waits until it accepts connections.

        It takes the place of an earlier one on the same port.
        """
        port = int((re.search(r"listen[\w-]*[= ][\w.]*:(\d+)", command) or [0, "50051"])[1])
        self._stop_server(port)
        # The shell writes down its environment and folder, which its second terminal takes over.
        before = pathlib.Path(self._scratch.name) / "environment.sh"
        self.run(f"export -p > {before}; echo cd '\"'$PWD'\"' >> {before}")
        server = self._servers[port] = subprocess.Popen(["bash", "-c", f". {before}; exec {command}"])
        deadline = time.monotonic() + DEADLINE_SECONDS
        while True:
            if server.poll() is not None:
                raise Failure(f"{command}\nended with status {server.returncode}")
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                return
            except OSError:
                if time.monotonic() > deadline:
                    raise Failure(f"{command}\ndoes not listen on port {port}") from None
                time.sleep(0.1)

    def run_python(self, text):
        if self._python is None:
            driver = pathlib.Path(self._scratch.name) / "driver.py"
            driver.write_text(PYTHON_DRIVER)
            before = pathlib.Path(self._scratch.name) / "environment.sh"
            self.run(f"export -p > {before}; echo cd '\"'$PWD'\"' >> {before}")
            self._python = subprocess.Popen(
                ["bash", "-c", f". {before}; exec python -u {driver}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
        block = pathlib.Path(self._scratch.name) / "block.py"
        block.write_text(text)
        return self._ask(self._python, f"{block}\n")

    def write(self, name, text):
        folder = pathlib.Path(self.run("pwd").strip())
        (folder / name).write_text(text)

    @staticmethod
    def _ask(process, text):
        process.stdin.write(text)
        process.stdin.flush()
        output = []
        for line in process.stdout:
            if line == "__ended__\n":
                return "".join(output)
            output.append(line)
        raise Failure(f"{text}\nprinted\n{''.join(output)}")

    def _stop_server(self, port):
        if server := self._servers.pop(port, None):
            server.terminate()
            server.wait()


def blocks_of(page):
    """Returns (language, text, name of the file or None) of each block of a page that is run."""
    text = page_of(page).read_text()
    for edit, replacement in EDITS.get(page, ()):
        assert edit in text, f"{page}: expected {edit!r}"
        text = text.replace(edit, replacement)
    end = 0
    for block in BLOCK.finditer(text):
        names = FILE_NAME.findall(text[end : block.start()])
        yield block[1], block[2], names[-1] if names else None
        end = block.end()


def server_of(commands):
    """Returns the command that starts a server if it is the last one of a block, and what comes before it."""
    lines = commands.replace("\\\n", " ").strip().splitlines()
    if lines[-1].startswith(SERVERS):
        return "\n".join(lines[:-1]), lines[-1]
    return commands, None


def play(page):
    terminal = Terminal()
    try:
        for language, text, name in blocks_of(page):
            print(f"  {language}: {name or text.strip().splitlines()[0]}", flush=True)
            if name is not None and language in ("python", "cmake", "cpp"):
                terminal.write(name, text)
            elif language == "python":
                print(terminal.run_python(text), end="")
            elif language in ("bash", "sh"):
                commands, server = server_of(text)
                print(terminal.run(commands), end="")
                if server is not None:
                    terminal.start(server)
    finally:
        terminal.close()


def main():
    known = {path.name for path in DOCS.rglob("*.md")}
    assert known == set(PAGES) | WITHOUT_COMMANDS, f"docs/: expected {sorted(known)} in PAGES or WITHOUT_COMMANDS"
    for page in sys.argv[1:] or PAGES:
        print(f"{page}", flush=True)
        began = time.monotonic()
        try:
            play(page)
        except Failure as failure:
            sys.exit(f"{page_of(page)}: expected that every block succeeds, received:\n{failure}")
        print(f"  {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
