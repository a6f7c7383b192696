"""The folder of a run: its settings, and the results of finished parts."""

from __future__ import annotations

import json
import pathlib
import shutil
import time
from collections.abc import Callable
from typing import Any

from spikeserve.check import check
from spikeserve.imitation.figures import Figures

# What runs of earlier releases did not write down; they continue without it.
_ADDED = ("env_id", "wrappers")


class Journal:
    """Keeps results below a folder, so that an interrupted run continues where it was.

    ValueError if the folder holds a run with other settings, or policies of something else.
    `overwrite` deletes the run in the folder first.
    """

    def __init__(
        self, folder: pathlib.Path, settings: dict[str, Any], overwrite: bool = False
    ) -> None:
        self.folder = folder
        path = folder / "settings.json"
        if overwrite and path.is_file():
            _delete_run(folder)
        foreign = folder / "policies"
        check(
            path.is_file() or not foreign.exists(),
            "out",
            "a new folder, or one of an earlier run",
            f"{foreign} without {path.name}",
        )
        folder.mkdir(parents=True, exist_ok=True)
        # Through JSON, because JSON turns tuples into lists.
        given = json.loads(json.dumps(settings))
        stored = json.loads(path.read_text()) if path.is_file() else given
        differing = [
            name
            for name, value in given.items()
            if stored.get(name, value if name in _ADDED else None) != value
        ]
        check(
            not differing,
            "out",
            f"the settings of {path}, another folder, or --overwrite",
            f"other {', '.join(differing)}",
        )
        self._write(path, settings)

    def figures(self, name: str, evaluate: Callable[[], Figures]) -> Figures:
        """Returns the stored figures of `name`, or evaluates and stores them."""
        stored = self.part(f"evaluations/{name}", lambda: evaluate().to_json())
        return Figures.from_json(stored)

    def part(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Returns the stored object of `name`, or makes and stores it with the seconds it took."""
        path = self.folder / f"{name}.json"
        if not path.is_file():
            begin = time.monotonic()
            made = make()
            self._write(path, made | {"seconds": round(time.monotonic() - begin, 1)})
        loaded: dict[str, Any] = json.loads(path.read_text())
        return loaded

    @staticmethod
    def _write(path: pathlib.Path, value: dict[str, Any]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(value, indent=2) + "\n")
        partial.rename(path)


def _delete_run(folder: pathlib.Path) -> None:
    """Deletes what a run has written into its folder, the settings last."""
    for name in ("data", "plans", "stages", "evaluations", "policies"):
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in ("report.md", "metadata.json", "settings.json"):
        (folder / name).unlink(missing_ok=True)
