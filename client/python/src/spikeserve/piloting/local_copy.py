"""`LocalCopy`: the session of the server on the robot's own engine."""

from __future__ import annotations

import collections
import hashlib
import importlib.util
import logging
import pathlib
import tempfile
import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.piloting.beat_log import Ending, Episode
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.values import Action
from spikeserve.wire import Message

LOGGER = logging.getLogger("spikeserve.pilot")


def is_wanted(options: PilotOptions) -> bool:
    """Returns whether the engine is to be used. ValueError if it is required and not installed."""
    if options.local is False:
        return False
    if importlib.util.find_spec("spikeserve_engine") is not None:
        return True
    if options.local:
        raise ValueError("local: expected the package spikeserve-engine, received none")
    return False


@dataclass
class _Beat:
    observation: NDArray[np.float32] | None
    reward: float
    executed_before: Action | None  # the action of the beat before
    position: tuple[int, int]  # episode and step in the server's session
    ending: Ending | None = None  # of the episode before, whose last action is `executed_before`


class LocalCopy:
    """Plays every beat that the robot plays, so that its session equals that of the server.

    A decision follows each beat on both sides, and the executed action takes its place, so the
    sessions are equal bit for bit. Thread-safe: the background thread catches up between beats.
    """

    def __init__(self, most_pending: int) -> None:
        self._lock = threading.Lock()  # of the session
        self._queue = threading.Lock()  # of what waits to be played
        self._session: Any = None
        self._pending: collections.deque[_Beat] = collections.deque()
        self._played: collections.deque[_Beat] = collections.deque(maxlen=most_pending)
        self._most_pending = most_pending
        self._answer: Action | None = None  # to the last beat that was played
        self._is_broken = False

    @property
    def is_ready(self) -> bool:
        """Returns whether the copy can decide."""
        return self._session is not None and not self._is_broken

    @property
    def is_broken(self) -> bool:
        """Returns whether the copy needs the value of the session again."""
        return self._is_broken

    @property
    def is_behind(self) -> bool:
        """Returns whether beats wait to be played."""
        return self.is_ready and len(self._pending) > 0

    def open(self, export: Message, policy: pathlib.Path | bytes) -> None:
        """Takes the session that the server has exported, and plays the beats that it lacks.

        ValueError or OSError if the policy is not the one that the server plays.
        """
        engine = importlib.import_module("spikeserve_engine")
        content = policy if isinstance(policy, bytes) else policy.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if digest != export.policy_sha256:
            source = "its content" if isinstance(policy, bytes) else str(policy)
            raise ValueError(
                f"local_policy: expected the file with SHA-256 {export.policy_sha256} that the "
                f"server plays, received {source} with {digest}"
            )
        if isinstance(policy, bytes):
            with tempfile.NamedTemporaryFile(suffix=".safetensors") as file:
                file.write(content)
                file.flush()
                played = engine.Engine(file.name)
        else:
            played = engine.Engine(policy)
        session = played.resume(export.value)
        with self._lock, self._queue:
            position = (export.episode, export.step)
            beats = [*self._played, *self._pending]
            while beats and beats[0].position < position:
                beats.pop(0)
            if beats and beats[0].position != position:
                raise ValueError(f"export: expected beat {beats[0].position}, received {position}")
            if beats and export.step == 0:
                beats[0] = replace(beats[0], ending=None)
            self._session, self._answer, self._is_broken = session, None, False
            self._pending = collections.deque(beats)
            self._played.clear()

    def add(
        self,
        observation: NDArray[np.float32] | None,
        reward: float,
        before: Action | None,
        position: tuple[int, int],
        ending: Ending | None,
    ) -> None:
        """Adds a beat, and the executed action of the beat before. `ending` ends its episode."""
        with self._queue:
            self._pending.append(_Beat(observation, reward, before, position, ending))
            if len(self._pending) > self._most_pending:
                self._pending.popleft()  # the session cannot be continued without it

    def begin_again(self, episode: Episode) -> None:
        """Waits for the value of a new session, whose first episode is `episode`."""
        with self._lock, self._queue:
            self._session, self._answer = None, None
            self._played.clear()
            self._pending.clear()
            before = None
            for step, beat in enumerate(episode.beats, episode.first):
                self._pending.append(_Beat(beat.observation, beat.reward, before, (0, step)))
                before = beat.executed

    def catch_up(self) -> Action | None:
        """Plays what was added. Returns the decision for the newest beat; None: there is none."""
        with self._lock:
            if not self.is_ready:
                return None
            try:
                while (beat := self._next()) is not None:
                    if beat.ending is not None:
                        self._played.clear()
                    self._played.append(beat)
                    self._play(beat)
            except Exception:
                LOGGER.exception("the engine on the robot failed")
                self._is_broken = True
                return None
            return self._answer

    def _next(self) -> _Beat | None:
        with self._queue:
            return self._pending.popleft() if self._pending else None

    def value(self) -> bytes:
        """Plays all beats, and returns the value of the session, as ExportSession of the server."""
        self.catch_up()
        with self._lock:
            return bytes(self._session.export())

    def _play(self, beat: _Beat) -> None:
        executed = beat.executed_before
        if beat.ending is not None:
            end = beat.ending
            self._session.end_episode(
                end.reward,
                end.terminated,
                end.truncated,
                end.target_return,
                executed_action=executed,
            )
            executed = None
        step = self._session.step
        check(step == beat.position[1], "beat", f"step {step}", beat.position[1])
        if beat.observation is None:
            self._session.skip(beat.reward, executed_action=executed)
            self._answer = None
            return
        decision = self._session.act(beat.observation, beat.reward, executed_action=executed)
        self._answer = decision.action
