"""The demonstration that keeps playing: its robots' pages, and its end by Ctrl-C."""

import json
import os
import pathlib
import re
import signal
import subprocess

from security import until
from serving import DEPLOY
from test_watching import get

BIN = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent


def test_three_robots_play_until_ctrl_c():
    demo = subprocess.Popen(
        [DEPLOY / "demo.sh", BIN], env=os.environ | {"PLAY": "1"}, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        pages = {}
        while len(pages) < 3:
            line = demo.stdout.readline()
            assert line, "the demonstration ended before it printed the pages of its robots"
            if found := re.fullmatch(r"  (\w+) +http://(\S+)/#/sessions/(\w+)\n", line):
                pages[found[1]] = found[2], found[3]
        assert list(pages) == ["CartPole", "Pendulum", "MountainCar"]
        for robot, (address, session) in pages.items():
            shown = json.loads(get(f"http://{address}/session.json?session={session}"))
            assert shown["labels"]["robot"] == robot
            before = int(shown["decisions"])
            until(lambda a=address, s=session, n=before: int(json.loads(get(f"http://{a}/session.json?session={s}"))["decisions"]) > n)
        os.killpg(demo.pid, signal.SIGINT)  # as a terminal does
        assert demo.wait(60) == 0
    finally:
        if demo.poll() is None:
            os.killpg(demo.pid, signal.SIGKILL)
        demo.stdout.close()
