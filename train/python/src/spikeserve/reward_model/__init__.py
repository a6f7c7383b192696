"""Judges the recorded episodes of a server: `python -m spikeserve reward_model`.

    recordings, seen = pathlib.Path("/tmp/recordings"), set()
    with spikeserve.Client() as client:
        for path, amended in follow(recordings, model, client, "my model", seen): ...

`model` is called with each Episode, and returns what Client.amend_episode takes: a dict such as
{"rewards": [...]} or {"reward": 1.0, "success": True}, a number (the same as "reward"), or None.
"""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import grpc

from spikeserve import (
    AmendedEpisode,
    Client,
    FailedPreconditionError,
    NotFoundError,
    SpikeserveError,
)
from spikeserve.conversion.data import Episode
from spikeserve.conversion.recordings import AMENDMENTS, files_of, read_file
from spikeserve.printing import say

Model = Callable[[Episode], Any]

# A wrong verdict, or another one than the episode has already: sent again, it is refused again.
_FINAL = (grpc.StatusCode.INVALID_ARGUMENT, grpc.StatusCode.ALREADY_EXISTS)


def follow(
    directory: pathlib.Path, model: Model, client: Client, name: str, seen: set[pathlib.Path]
) -> Iterator[tuple[pathlib.Path, AmendedEpisode]]:
    """Judges the episodes below `directory` that `name` has not judged, and yields the verdicts.

    `seen` has those that need not be looked at again. A file that cannot be read, and a verdict
    that the server refuses for good, are said on standard error. Another error is raised; the next
    call goes on with that episode, and sends the same verdict again.
    """
    for path in files_of(directory):
        if path in seen:
            continue
        if not _is_judged(path, name):
            amended = judge(path, model, client, name)
            if amended is not None:
                yield path, amended
        seen.add(path)


def judge(path: pathlib.Path, model: Model, client: Client, name: str) -> AmendedEpisode | None:
    """Amends one recorded episode, and the session that waits for its verdict."""
    try:
        episode = read_file(path).episodes[0]
    except ValueError as error:
        say(error, error=True)
        return None
    served = episode.served or {}
    verdict = model(episode)
    if verdict is None or "episode" not in served:
        return None
    if not isinstance(verdict, dict):
        verdict = {"reward": float(verdict)}
    refusal: SpikeserveError | None = None
    # The session may be closed, or its time may be over. Then the verdict is for the recording.
    for target in filter(None, (served.get("session"), path.parent.name)):
        try:
            return client.amend_episode(target, served["episode"], name, author=name, **verdict)
        except (NotFoundError, FailedPreconditionError) as error:
            refusal = error
        except SpikeserveError as error:
            if error.code not in _FINAL:
                raise
            refusal = error
            break
    say(f"{path}: {refusal}", error=True)
    return None


def _is_judged(path: pathlib.Path, name: str) -> bool:
    lines = path.with_suffix(AMENDMENTS)
    if not lines.exists():
        return False
    given = (json.loads(line) for line in lines.read_text().splitlines())
    return any(amendment["amendment_id"] == name for amendment in given)
