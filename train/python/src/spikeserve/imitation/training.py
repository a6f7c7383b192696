"""Runs `spiketrain`."""

from __future__ import annotations

import json
import os
import pathlib
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from spikeserve.check import check


def find_spiketrain(path: str | None = None) -> str:
    """Returns the program: `path`, $SPIKETRAIN, the one beside this Python, or the one on PATH."""
    named = path or os.environ.get("SPIKETRAIN")
    beside = pathlib.Path(sys.executable).with_name("spiketrain")
    found = named or (str(beside) if beside.is_file() else shutil.which("spiketrain"))
    check(
        found is not None, "spiketrain", "the program on PATH, in $SPIKETRAIN or as an option", None
    )
    program = shutil.which(str(found))
    check(program is not None, "spiketrain", "a program", found)
    return os.path.abspath(str(program))


@dataclass(frozen=True)
class Training:
    """The flags of one training."""

    data: Sequence[pathlib.Path]
    seed: int
    iterations: int
    flags: Sequence[str] = ()
    init: pathlib.Path | None = None  # policy to continue from


@dataclass
class Spiketrain:
    """Trains and quantises policies. `commands` are the command lines that ran.

    Runs in `folder`, which contains all files, so that the records of policies name them by paths
    that do not depend on the machine.
    """

    program: str
    threads: int
    folder: pathlib.Path
    commands: list[str] = field(default_factory=list)

    def check_flags(self, flags: Sequence[str]) -> None:
        """ValueError if `spiketrain train` refuses flags, before it has data to train on."""
        # It checks the number of episodes after the other values: a wrong one makes it end there.
        finished = subprocess.run(
            [self.program, "train", "--out=.", *flags, "--episodes=0"],
            check=False,
            capture_output=True,
            text=True,
        )
        refusal = finished.stderr.strip()
        expected = "flags that `spiketrain train` takes"
        check("--episodes: " in refusal, "train_flags", expected, f"{shlex.join(flags)}: {refusal}")

    def train(self, training: Training, out: pathlib.Path) -> pathlib.Path:
        """Trains into the folder `out` and returns the policy. Continues an interrupted run."""
        flags = [
            f"--data={self._datasets(training.data)}",
            f"--out={self._relative(out)}",
            f"--seed={training.seed}",
            f"--iterations={training.iterations}",
            *([f"--threads={self.threads}"] if self.threads != 1 else []),
            "--episodes=1",  # of its own evaluation, which is not used here
            "--no_baselines",  # compare() fits them once, on all data
            "--resume",
            *training.flags,
        ]
        if training.init is not None:
            flags.append(f"--init={self._relative(training.init)}")
        policy = out / "policy.safetensors"
        if not policy.is_file():
            self._run("train", *flags)
        return policy

    def quantize(
        self, policy: pathlib.Path, data: Sequence[pathlib.Path], out: pathlib.Path
    ) -> pathlib.Path:
        """Writes the policy in integers, calibrated on the data, to the file `out`."""
        if not out.is_file():
            # What it lost is judged afterwards, on the starts of the evaluation.
            self._quantize(policy, data, out, "--episodes=1", "--max_loss=1")
        return out

    def judge(
        self, policy: pathlib.Path, data: Sequence[pathlib.Path], out: pathlib.Path, returns: Any
    ) -> dict[str, Any]:
        """Writes what quantize() does again, with what it lost in its record. Returns the verdict.

        `returns` has those `before` and `after`, on equal starts, and the mean `random` one.
        """
        played = out.with_name("returns.json")
        played.parent.mkdir(parents=True, exist_ok=True)
        played.write_text(json.dumps(returns))
        flags = f"--returns={self._relative(played)}", "--allow_loss", "--json"
        verdict: dict[str, Any] = json.loads(self._quantize(policy, data, out, *flags))["verdict"]
        return verdict

    def _quantize(
        self, policy: pathlib.Path, data: Sequence[pathlib.Path], out: pathlib.Path, *flags: str
    ) -> str:
        source, target = self._relative(policy), self._relative(out)
        files = f"--policy={source}", f"--out={target}", f"--data={self._datasets(data)}"
        return self._run("quantize", "--prune", *files, *flags)

    def compare(
        self, policy: pathlib.Path, data: Sequence[pathlib.Path], out: pathlib.Path
    ) -> pathlib.Path:
        """Writes the comparison of the policy with baselines on the data to the file `out`."""
        if not out.is_file():
            files = f"--policy={self._relative(policy)}", f"--out={self._relative(out)}"
            self._run("compare", *files, f"--data={self._datasets(data)}", "--episodes=1")
        return out

    def _datasets(self, data: Sequence[pathlib.Path]) -> str:
        return ",".join(str(self._relative(path)) for path in data)

    def _relative(self, path: pathlib.Path) -> pathlib.Path:
        return path.relative_to(self.folder)

    def _run(self, *arguments: str) -> str:
        command = [self.program, *arguments]
        self.commands.append(shlex.join(command))
        finished = subprocess.run(
            command,
            cwd=self.folder,
            check=False,
            stdout=subprocess.PIPE,
            text=True,
        )
        if finished.returncode != 0:
            raise RuntimeError(
                f"{shlex.join(command)}: status {finished.returncode}\n{finished.stdout}"
            )
        return finished.stdout
