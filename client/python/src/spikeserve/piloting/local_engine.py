"""`LocalEngine`: the session of the server on the robot's own engine."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import pathlib
import tempfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from spikeserve.check import check
from spikeserve.executed import SOURCES, Executed
from spikeserve.piloting.pilot_options import PilotOptions
from spikeserve.piloting.robot_messages import from_robot
from spikeserve.values import Action
from spikeserve.wire import Message


def is_wanted(options: PilotOptions) -> bool:
    """Returns whether the engine is to be used. ValueError if it is required and not installed."""
    if options.local is False:
        return False
    if importlib.util.find_spec("spikeserve_engine") is not None:
        return True
    if options.local:
        raise ValueError("local: expected the package spikeserve-engine, received none")
    return False


class LocalEngine:
    """Plays what the state machine says: every step that the robot plays.

    A decision follows each step on both sides, and the executed action takes its place, so the
    sessions are equal bit for bit. For one thread, but `value`.
    """

    def __init__(self, policy: Any) -> None:
        self._path = policy  # that of PilotOptions.local_policy
        self._session: Any = None

    @property
    def needs_policy(self) -> bool:
        """Returns whether the server has to send the policy file."""
        return self._path is None

    def resume(self, export: Message) -> None:
        """Takes the session that the server has exported.

        ValueError or OSError if the policy is not the one that the server plays.
        """
        engine = importlib.import_module("spikeserve_engine")
        path = self._path_of(export)
        content = bytes(export.policy_file) if path is None else path.read_bytes()
        check(len(content) > 0, "local_policy", "the policy file", "none")
        digest, source = hashlib.sha256(content).hexdigest(), path or "its content"
        expected = f"the file with SHA-256 {export.policy_sha256} that the server plays"
        check(digest == export.policy_sha256, "local_policy", expected, f"{source} with {digest}")
        with contextlib.ExitStack() as stack:
            if path is None:
                file = stack.enter_context(tempfile.NamedTemporaryFile(suffix=".safetensors"))
                file.write(content)
                file.flush()
            played = engine.Engine(file.name if path is None else path)
        self._session = played.resume(export.value)

    def play(self, work: Mapping[str, Any]) -> Action:
        """Plays a step, or the end of an episode. Returns the decision; 0 if there is none."""
        given = work["executed"]
        executed = None
        if given is not None:
            executed = Executed(from_robot(given), SOURCES[work["source"]], work["operator_id"])
        if work["is_end"]:
            self._session.end_episode(
                work["reward"],
                work["terminated"],
                work["truncated"],
                work["target_return"],
                executed_action=executed,
            )
            return 0
        step = self._session.step
        check(step == work["step"], "beat", f"step {step}", work["step"])
        observation = np.frombuffer(work["observation"], np.float32)
        if observation.size == 0:
            self._session.skip(work["reward"], executed_action=executed)
            return 0
        decision = self._session.act(observation, work["reward"], executed_action=executed)
        action: Action = decision.action
        return action

    def value(self) -> bytes:
        """Returns the value of the session, as ExportSession of the server."""
        return bytes(self._session.export())

    def _path_of(self, export: Message) -> pathlib.Path | None:
        if self._path is None:
            return None
        path = pathlib.Path(self._path)
        if path.is_dir():
            path = path / str(export.policy) / str(export.version) / "policy.safetensors"
        return path
