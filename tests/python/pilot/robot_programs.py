"""Robots in C, Rust and Go: builds the programs of tests/install/robot against the packages, and flies with them."""

import atexit
import functools
import json
import os
import pathlib
import shutil
import subprocess
import tempfile
from types import SimpleNamespace

import numpy as np
import spikeserve
from cpp_pilot import CppPilot, CppSummary, code_of
from google.protobuf.json_format import MessageToJson
from serving import run
from spikeserve.errors import make_error
from spikeserve.executed import source_of

ROOT = pathlib.Path(__file__).parents[3]
SOURCES = ROOT / "tests/install/robot"
# Makes packages of two components alone, quickly.
CONFIG = """include({}/CPackConfig.cmake)
set(CPACK_COMPONENTS_ALL robot robot_dev)
set(CPACK_DEBIAN_COMPRESSION_TYPE gzip)
"""


@functools.cache
def installed():
    """Unpacks the Debian packages of the shared library. Returns its folder and the environment that finds it."""
    folder = pathlib.Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder)
    (folder / "config.cmake").write_text(CONFIG.format(os.environ["SPIKESERVE_BUILD_DIR"]))
    run("cpack", "-G", "DEB", "--config", folder / "config.cmake", "-B", folder / "packages")
    for package in (folder / "packages").glob("*.deb"):
        run("dpkg-deb", "--extract", package, folder / "root")
    [pc] = (folder / "root").rglob("spikeserve_robot.pc")
    library = str(pc.parents[1])
    paths = {"PKG_CONFIG_PATH": str(pc.parent), "LIBRARY_PATH": library, "LD_LIBRARY_PATH": library}
    return pc.parents[1], os.environ | paths


def build_c(folder, source=SOURCES / "fly.c"):
    _, environment = installed()
    flags = run("pkg-config", "--cflags", "--libs", "spikeserve_robot", env=environment).stdout.split()
    strict = ["-std=c11", "-pedantic", "-Wall", "-Wextra", "-Werror"]
    program = folder / "program"
    run("gcc", *strict, source, "-o", program, *flags, env=environment)
    return program


class OtherPilot(CppPilot):
    """Starts `program`, which fly.c describes."""

    def __init__(
        self, program, client, policy, period, session=None, local=None, prefix=(),
        max_age=-1.0, action="-", transport=0, hold_beats=-1,
    ):  # fmt: skip
        opening = (session or spikeserve.SessionOptions()).to_wire(policy)
        opening = MessageToJson(opening, indent=None, preserving_proto_field_name=True).replace(" ", "")
        servers = client if isinstance(client, str) else ",".join(r.address for r in client.replicas)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen([*prefix, program], env=installed()[1], **pipes)
        local = "-" if local is False else '""'
        self._say("open", servers, policy, opening, period, max_age, local, action, transport, hold_beats)

    def _say(self, *words):
        print(*words, file=self.process.stdin, flush=True)
        answer = json.loads(self.process.stdout.readline())
        if isinstance(answer, dict) and "error" in answer:
            raise make_error("robot", code_of(answer["code"]), answer["error"])
        return answer

    def _ask(self, do, **words):
        return self._say(do, *words.values())

    def beat(self, observation, reward=0.0, *, executed_action=()):
        by = source_of(executed_action)
        executed_action = getattr(executed_action, "action", executed_action)
        numbers = map(float, [*observation, *executed_action])
        answer = self._say("beat", reward, by[0], by[1] or "-", len(observation), *numbers)
        if isinstance(answer["action"], list):
            answer["action"] = np.float32(answer["action"])
        return SimpleNamespace(**answer)

    def end_episode(self, reward, terminated=False):
        return CppSummary(self._ask, self._say("end", reward, int(terminated))["episode"])

    def close(self):
        super().close()
        self.process.stdin.close()
        self.process.stdout.close()
        assert self.process.wait() == 0
