"""Imports the optional packages of the formats."""

from __future__ import annotations

import importlib
from typing import Any

from spikeserve.check import check


def package(name: str) -> Any:
    """Imports the module `name`. ValueError, which names the extra, if its package is missing."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or name).partition(".")[0]
        expected = "the package, which the extra [robots] of spikeserve-train installs"
        check(missing != name.partition(".")[0], missing, expected, "none")
        raise
