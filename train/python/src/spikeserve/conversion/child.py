"""Reads untrusted files in a child process with limits, as `spiketrain` reads Minari's.

A file that makes a library crash, run without end or take all memory is an error, too. The child
returns JSON and arrays, nothing that could run as code.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np

from spikeserve.conversion.data import Episode, RobotData, space_from_json, space_to_json

_MOST_SECONDS = 3600  # of the processor
LEAST_BYTES = 1 << 30  # that any file may take in memory
GROWTH = 64  # bytes of memory for each byte of the files
_LONGEST_ERROR = 4000
_ARRAYS = ("observations", "actions", "rewards", "labels", "weights")


def read_in_child(read: Callable[[], RobotData], source_bytes: int) -> RobotData:
    """Returns what `read` returns in a child process. ValueError or OSError as `read` raises them.

    ValueError, too, if `read` takes more memory than files of `source_bytes` may.
    """
    if not hasattr(os, "fork"):
        return read()
    with tempfile.TemporaryFile() as file:
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            _run(read, source_bytes, file)  # does not return
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        if code != 0:
            expected = "data that can be read, received some that ended the process which read them"
            raise ValueError(f"source: expected {expected} (status {code})")
        file.seek(0)
        return _decode(file)


def _run(read: Callable[[], RobotData], source_bytes: int, file: Any) -> None:
    """Writes the result of `read`, or its error, and ends the process without any clean-up."""
    code = 1
    try:
        most = _limit(source_bytes)
        try:
            _encode(read(), file)
        except MemoryError:
            reason = f"source: expected data that fit into {most >> 20} MiB, received more"
            _encode_error(ValueError(reason), file)
        except Exception as error:
            _encode_error(error, file)
        file.flush()
        code = 0
    finally:
        os._exit(code)


def _limit(source_bytes: int) -> int:
    """Limits this process. Returns the bytes that it may take from now on."""
    import resource

    page = os.sysconf("SC_PAGE_SIZE")
    half = os.sysconf("SC_PHYS_PAGES") // 2 * page
    most = min(half, LEAST_BYTES + GROWTH * source_bytes)
    used = 0
    if os.path.exists("/proc/self/statm"):
        with open("/proc/self/statm") as statm:
            used = int(statm.read().split()[5]) * page
    for limit, value in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, _MOST_SECONDS),
        (resource.RLIMIT_DATA, used + most),
    ):
        resource.setrlimit(limit, (value, value))
    return most


def _encode_error(error: Exception, file: Any) -> None:
    file.seek(0)
    file.truncate()
    kind = "OSError" if isinstance(error, OSError) else "ValueError"
    known = isinstance(error, OSError | ValueError)
    text = str(error) if known else f"source: {type(error).__name__}: {error}"
    _write_json(file, {"error": kind, "text": text[:_LONGEST_ERROR]})


def _write_json(file: Any, value: Any) -> None:
    encoded = json.dumps(value).encode()
    file.write(len(encoded).to_bytes(8, "little") + encoded)


def _encode(data: RobotData, file: Any) -> None:
    header = {
        field.name: getattr(data, field.name)
        for field in dataclasses.fields(RobotData)
        if field.name not in ("episodes", "action_space")
    }
    episodes = []
    for episode in data.episodes:
        values = {field.name: getattr(episode, field.name) for field in dataclasses.fields(Episode)}
        arrays = [name for name in _ARRAYS if values.pop(name) is not None]
        episodes.append(values | {"arrays": arrays})
    _write_json(file, header | {"space": space_to_json(data.action_space), "episodes": episodes})
    for episode in data.episodes:
        for name in _ARRAYS:
            if getattr(episode, name) is not None:
                np.save(file, getattr(episode, name), allow_pickle=False)


def _decode(file: Any) -> RobotData:
    header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    if "error" in header:
        raise (OSError if header["error"] == "OSError" else ValueError)(header["text"])
    space = space_from_json(header.pop("space"), "source: action_space")
    episodes = []
    for values in header.pop("episodes"):
        arrays = {name: np.load(file, allow_pickle=False) for name in values.pop("arrays")}
        episodes.append(Episode(**values, **arrays))
    for key in ("observation_names", "action_names"):
        header[key] = tuple(header[key])
    return RobotData(action_space=space, episodes=episodes, **header)
