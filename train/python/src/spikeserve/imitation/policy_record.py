"""Writes what is known about a policy into its file."""

from __future__ import annotations

import json
import pathlib
from typing import Any

import safetensors
import safetensors.numpy


def write_with_record(source: pathlib.Path, target: pathlib.Path, record: dict[str, Any]) -> None:
    """Copies a policy file and adds `record` to its `training`. Replaces `target` as a whole."""
    with safetensors.safe_open(source, framework="np") as file:
        metadata = dict(file.metadata())
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    metadata["training"] = json.dumps(json.loads(metadata["training"]) | record)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_suffix(".partial")
    safetensors.numpy.save_file(tensors, partial, metadata)
    partial.chmod(0o644)  # the user of a server may be another one
    partial.rename(target)
