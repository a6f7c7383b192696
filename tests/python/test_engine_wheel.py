"""A wheel of the engine is made from the checkout, needs no library of the build machine, and plays."""

import os
import pathlib
import re
import subprocess
import sys
import zipfile

from serving import SHIPPED_POLICIES

PACKAGE = pathlib.Path(__file__).parents[2] / "client/python/engine"
POLICY = SHIPPED_POLICIES / "cartpole/2/policy.safetensors"
PLAY = f"""
import spikeserve_engine
session = spikeserve_engine.Engine({str(POLICY)!r}).session(learning=spikeserve_engine.Learning(rule="hebbian"))
print([session.act([0.01, 0.0, 0.02, 0.0], 1.0).stats.spikes for _ in range(30)], spikeserve_engine.__file__)
"""


def run(*arguments, **options):
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, **options).stdout


def test_a_wheel_is_enough_to_play(tmp_path):
    # The requirements of the tests include the build tools, so pip needs no network.
    pip = ["-m", "pip", "--disable-pip-version-check"]
    build = f"--config-settings=build-dir={tmp_path}/build"
    run(*pip, "wheel", "--quiet", "--no-deps", "--no-build-isolation", build, f"--wheel-dir={tmp_path}/raw", PACKAGE)
    (raw,) = (tmp_path / "raw").glob("*.whl")
    tools = f"{pathlib.Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    run("-m", "auditwheel", "repair", f"--wheel-dir={tmp_path}", raw, env=os.environ | {"PATH": tools})
    (wheel,) = tmp_path.glob("*.whl")
    assert re.search(rf"^spikeserve_engine-{os.environ['SPIKESERVE_VERSION']}-cp.*-manylinux_2_\d+_x86_64", wheel.name)
    names = zipfile.ZipFile(wheel).namelist()
    assert "spikeserve_engine/_engine.pyi" in names
    assert not [name for name in names if re.search(r"grpc|protobuf|torch", name)]
    run(*pip, "install", "--quiet", "--no-deps", f"--target={tmp_path}/installed", wheel)
    spikes, file = run("-c", PLAY, env=os.environ | {"PYTHONPATH": f"{tmp_path}/installed"}).rsplit(" ", 1)
    assert pathlib.Path(file.strip()).is_relative_to(tmp_path / "installed")
    in_build_tree, _ = run("-c", PLAY).rsplit(" ", 1)
    assert spikes == in_build_tree
