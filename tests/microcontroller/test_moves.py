"""A session moves between a running server and a chip, a thousand times in mid-episode: not a bit differs.

The chip takes the value that the server exports. What it decides goes to the server as a beat of the robot. Only the server tests
the wiring, and keeps the state of this test behind the session.
"""

import os
import struct
import subprocess

import gymnasium
import pytest
from emitted import FORMAT, emit, shipped
from emulated import CHIPS
from policy_file import copy_without_wiring
from serving import running_server

MOVES = 1000


class Chip:
    """The C of a policy in a process, of this machine or of an emulator, that plays calls while they are written."""

    def __init__(self, emitted, name):
        self.folder = emitted.folder
        if name == "host":
            program, stream = emitted.compile(["gcc"], "-O2"), subprocess.PIPE
            command = [program]
        else:
            emitted.stream.unlink()
            os.mkfifo(emitted.stream)  # the emulated program opens the file `stream`
            command, stream = CHIPS[name].command(CHIPS[name].link(emitted, "-Os")), None
        self.process = subprocess.Popen(
            command, cwd=emitted.folder, stdin=stream, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        self.calls = self.process.stdin or open(emitted.stream, "wb")

    def continued(self, value, observation, reward):
        """Decides the next step of a session. Returns the action and the value of the session."""
        self.calls.write(b"I" + struct.pack("<I", len(value)) + value)
        self.calls.write(b"D" + observation.tobytes() + struct.pack("<dB", reward, 0) + b"P")
        self.calls.flush()
        return [bytes.fromhex(part.decode()) for part in self.process.stdout.readline().split()]

    def close(self):
        self.calls.write(b"Q")
        self.calls.close()
        assert self.process.wait(timeout=60) == 0


def is_same(server, chip):
    """Returns whether the values of a session are equal, but for a test of the wiring."""
    size = len(FORMAT)
    is_longer = server[size] == chip[size] + 1
    return server == chip or (is_longer and server[size + 1 :].startswith(chip[size + 1 : -8]))


def as_action(numbers, discrete):
    if discrete:
        return {"discrete": struct.unpack("<i", numbers)[0]}
    return {"continuous": {"values": struct.unpack(f"<{len(numbers) // 4}f", numbers)}}


def play(service, chip, environment, opening):
    """Plays episodes in which server and chip decide in turn; returns the moves."""
    session = service.OpenSession(**opening)
    discrete = hasattr(environment.action_space, "n")
    moves = decision = episode = 0
    while moves < MOVES:
        observation, _ = environment.reset(seed=episode)
        step, reward, total, ended = 0, 0.0, 0.0, False
        while not ended:
            beat = {"observation": observation, "reward": reward}
            if step % 2 == 0:
                answer = service.Act(session_id=session.session_id, step=step, decision=decision, **beat)
                action = answer.action.discrete if discrete else answer.action.continuous.values
            else:
                value = service.ExportSession(session_id=session.session_id).value
                numbers, continued = chip.continued(value, observation, reward)
                executed = as_action(numbers, discrete)
                beat |= {"step": step, "executed": executed}
                service.Act(session_id=session.session_id, step=step + 1, decision=decision + 1, history=[beat])
                assert is_same(service.ExportSession(session_id=session.session_id).value, continued)
                action = executed["discrete"] if discrete else executed["continuous"]["values"]
                moves += 1
            observation, reward, terminated, truncated, _ = environment.step(action if discrete else list(action))
            total, step, decision, ended = total + float(reward), step + 1, decision + 1, terminated or truncated
        summary = service.EndEpisode(session_id=session.session_id, reward=reward, terminated=terminated)
        assert (summary.episode_return, summary.steps) == (pytest.approx(total, abs=1e-9), step)
        episode += 1
    return moves


OPENINGS = {
    "greedy": ("CartPole-v1", {"policy": "cartpole-small"}),
    "sampled": ("CartPole-v1", {"policy": "cartpole-small", "action_selection": "SAMPLE", "temperature": 0.7, "seed": 3}),
    "box": ("Pendulum-v1", {"policy": "pendulum"}),
}


@pytest.mark.parametrize("name, kind", [("host", "greedy"), ("host", "sampled"), ("host", "box"), ("cortex-m4", "greedy")])
def test_a_thousand_moves(tmp_path, name, kind):
    environment, opening = OPENINGS[kind]
    [source] = [file.parent for file in shipped() if file.parent.parent.name == opening["policy"]]
    file = tmp_path / "policies" / opening["policy"] / source.name / "policy.safetensors"
    copy_without_wiring(source, file.parent)  # whose test is part of the server's value, and not of the chip's
    with running_server(tmp_path / "policies") as server:
        chip = Chip(emit(file, tmp_path, decisions=1), name)
        assert play(server.agent, chip, gymnasium.make(environment), opening) >= MOVES
        chip.close()
