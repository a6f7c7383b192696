"""Plays CartPole with the arm64 wheel of the Python engine, in Debian's arm64 CPython under qemu, and fails below 500.0.

It installs the wheel, NumPy and Gymnasium as pip would on a robot, without the network of the robot's processor.

usage: wheel.py STUB   STUB is the file _engine.pyi of a build for this machine
"""

import pathlib
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).parents[2]
EMULATE = ROOT / "tests/arm64/emulate.sh"
PYTHON = ROOT / "build/arm64-root/usr/bin/python3.11"
PLATFORMS = [f"--platform=manylinux_2_{minor}_aarch64" for minor in (17, 27, 28, 34, 35, 36)]
PLAY = """
import platform, gymnasium, spikeserve_engine
engine = spikeserve_engine.Engine("deploy/policies/cartpole/2/policy.safetensors")
environment = gymnasium.make("CartPole-v1")
returns = []
for seed in (3000000, 3000001):
    session, (observation, _), total, ended = engine.session(seed=seed), environment.reset(seed=seed), 0.0, False
    reward = 0.0
    while not ended:
        decision = session.act(observation.tolist(), reward)
        observation, reward, terminated, truncated, _ = environment.step(int(decision.action))
        total, ended = total + reward, terminated or truncated
    returns.append(total)
print(platform.machine(), "CPython", platform.python_version(), returns)
assert platform.machine() == "aarch64" and returns == [500.0, 500.0], returns
"""


def main(stub):
    with tempfile.TemporaryDirectory() as folder:
        wheels, site = pathlib.Path(folder, "wheels"), pathlib.Path(folder, "site")
        build = ROOT / "client/python/build_wheels.sh"
        subprocess.run([build, "--arm64", stub, wheels, sys.executable, "/usr/bin/python3"], check=True)
        wheel = next(wheels.glob("spikeserve_engine-*_aarch64.whl"))
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB", flush=True)
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", f"--target={site}"]
        binaries = ["--python-version=3.11", "--only-binary=:all:", *PLATFORMS]
        subprocess.run([*pip, *binaries, wheel, "gymnasium"], check=True)
        files = [file for file in (site / "spikeserve_engine").iterdir() if file.is_file()]
        print(f"installed: {sum(file.stat().st_size for file in files) / 1e6:.1f} MB", flush=True)
        played = ["env", f"PYTHONPATH={site}", EMULATE, PYTHON, "-c", PLAY]
        return subprocess.run(played, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
