"""Makes C of policies with `spikectl emit-c`, and compares what it decides with the engine of the server."""

import hashlib
import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

SOURCES = Path(__file__).parent
ROOT = SOURCES.parent.parent
SPIKECTL = os.environ["SPIKECTL_PROGRAM"]
CHIP_STREAM = os.environ["CHIP_STREAM_PROGRAM"]
FORMAT = b"\x82\x75spikeserve.session.v1"  # the first bytes of the value of a session; the number of its items follows
C99 = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]


def shipped():
    """Returns the files of the shipped policies, smallest first."""
    return sorted((ROOT / "deploy/policies").glob("*/*/policy.safetensors"), key=lambda file: file.stat().st_size)


def name_of(file):
    return f"{file.parent.parent.name}-{file.parent.name}"


def run(*command, **options):
    return subprocess.run([str(part) for part in command], check=True, capture_output=True, text=True, **options).stdout


@dataclass
class Emitted:
    """The C of a policy, and the calls and the hash of answers of the server to compare it with."""

    folder: Path
    sizes: dict
    stream: Path
    hash: str

    def compile(self, compiler, *flags, program="chip_play.c", port="port_host.c", out="play"):
        sources = [SOURCES / program, *([SOURCES / port] if port else [])]
        where = [f"-I{self.folder}", f"-I{SOURCES}", "-o", self.folder / out]
        run(*compiler, *C99, *where, self.folder / "spike_policy.c", *sources, *flags)
        return self.folder / out


def emit(file, folder, decisions):
    """Makes C of a policy, and the stream of `decisions` decisions."""
    sizes = json.loads(run(SPIKECTL, "emit-c", f"--policy={file}", f"--out={folder}", "--json"))
    digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    stream = Path(folder) / "stream"
    answers = run(CHIP_STREAM, file, sizes["policy"], sizes["version"], digest, decisions, stream)
    return Emitted(Path(folder), sizes, stream, answers.strip().zfill(16))


def play(emitted, program, emulator=()):
    """Returns the hash of what a program answers to the stream."""
    with open(emitted.stream, "rb") as stream:
        return run(*emulator, program, stdin=stream).split()[0]
