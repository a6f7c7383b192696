"""Plays episodes of a Gymnasium environment with the actions of a microcontroller (main.c); prints their mean return.

usage: play.py ENVIRONMENT EPISODES FIRMWARE.elf     in QEMU, or
       play.py ENVIRONMENT EPISODES /dev/ttyACM0     on a board (needs pyserial)
"""

import struct
import subprocess
import sys

import gymnasium
import numpy as np

QEMU = ["qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "stdio", "-kernel"]


def open_port(name):
    """Returns what reads from the chip, what writes to it, and the emulator."""
    if name.startswith("/dev/"):
        import serial

        port = serial.Serial(name, 115200)
        return port, port, None
    emulator = subprocess.Popen([*QEMU, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    return emulator.stdout, emulator.stdin, emulator


def main():
    environment, episodes = gymnasium.make(sys.argv[1]), int(sys.argv[2])
    source, sink, emulator = open_port(sys.argv[3])
    try:
        print(f"mean return {np.mean(play(environment, episodes, source, sink)):.1f}")
    except (BrokenPipeError, EOFError):  # QEMU has ended
        sys.exit(f"play.py: expected an action, received the end of {sys.argv[3]}")
    finally:
        if emulator:
            emulator.kill()


def play(environment, episodes, source, sink):
    """Returns the returns of the episodes."""
    is_discrete = hasattr(environment.action_space, "n")
    size = 4 if is_discrete else 4 * environment.action_space.shape[0]
    event, reward, returns = b"s", 0.0, []
    for episode in range(episodes):
        observation, _ = environment.reset(seed=episode)
        total, terminated, truncated = 0.0, False, False
        while not (terminated or truncated):
            sink.write(event + struct.pack("<d", reward) + observation.astype("<f4").tobytes())
            answer = b""
            while len(answer) < size:
                read = source.read(size - len(answer))
                if not read:
                    raise EOFError
                answer += read
            action = struct.unpack("<i", answer)[0] if is_discrete else np.frombuffer(answer, "<f4")
            observation, reward, terminated, truncated, _ = environment.step(action)
            reward, event = float(reward), b"s"
            total += reward
        event = b"t" if terminated else b"e"
        returns.append(total)
    return returns


if __name__ == "__main__":
    main()
