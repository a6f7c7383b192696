"""Counts the beats of robots without a fresh action, over links with delay, loss, cuts, and servers that fail.

    python lab/bench/beats_bench.py --bin=build/release/bin --pages

Each robot has a link of its own between two network namespaces (link_emulator.cc), so this needs root. A row is a case
and a robot, "50 ms, 1% lost: pilot". Rows that the JSON file has are not run again, unless `--rows` matches their name.
"""

import argparse
import concurrent.futures
import contextlib
import json
import os
import pathlib
import re
import subprocess
import sys
import threading
import time

ROOT = pathlib.Path(__file__).parents[2]
BENCH = ROOT / "lab/bench"
sys.path[:0] = [str(ROOT / "tests/python")]

import programs  # noqa: E402
from beats_cases import CASES  # noqa: E402
from beats_site import Site  # noqa: E402
from beats_table import pages  # noqa: E402
from own_environment import python_with  # noqa: E402

RIVAL = ("openpi-client==0.1.2", "gymnasium==1.4.0")


def start_robots(site, case, player, seconds, folder, rival):
    """Starts the robots of a row. Returns their process once they play."""
    if player == "openpi":
        address = site.start_openpi(rival, BENCH / "openpi_server.py")
        command = [str(rival), str(BENCH / "openpi_robot.py"), address, str(case.rate), str(seconds)]
    else:
        flags = {"server": site.start_servers(case.store, (*case.prefix, *case.server_prefix)), "player": player, "robots": case.robots}
        flags |= {"connections": case.connections, "rate": case.rate, "seconds": seconds}
        command = [str(folder / "robots"), *(f"--{name}={value}" for name, value in flags.items())]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    space = site.server if case.round_trip is None else site.robot
    command = [*space.prefix, *case.prefix, *command]
    robots = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert robots.stdout.readline() == "playing\n", f"{case.name}, {player}: the robots do not play"
    return robots


def play(case, player, seconds, folder, rival):
    """Returns the figures of a row."""
    with contextlib.ExitStack() as stack:
        site = Site(stack, folder / "link_emulator")
        if case.round_trip is not None:
            site.link.order("set", case.round_trip / 2, case.loss, case.burst)
        robots = start_robots(site, case, player, seconds + case.longer, folder, rival)
        if case.disturb is not None:
            time.sleep(seconds / 4)
            case.disturb(site)
        used = -processor_seconds(site)
        output, _ = robots.communicate()
        assert robots.returncode == 0
        used += processor_seconds(site)
        figures = json.loads(output)
        figures |= {"server_seconds": used / figures["beats"], "machine": machine(), "load": os.getloadavg()[0]}
        return {name: round(value, 6) if isinstance(value, float) else value for name, value in figures.items()}


def processor_seconds(site):
    """Returns what the servers have used. Of those that a case ends, the end shows nothing."""
    return sum(programs.processor_seconds(server.pid) for server in site.servers)


def machine():
    """Returns the name of the machine's processors."""
    models = re.findall(r"^model name\s*: (.*)", pathlib.Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return f"{os.cpu_count()} × {models[0] if models else os.uname().machine}"


class Rows:
    """The finished rows by name, in a file. Thread-safe."""

    def __init__(self, path):
        self._path, self._lock = path, threading.Lock()
        self.finished = json.loads(path.read_text()) if path.exists() else {}

    def add(self, name, figures):
        with self._lock:
            self.finished[name] = figures
            part = self._path.with_suffix(".part")
            lines = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in self.finished.items())
            part.write_text("{\n" + ",\n".join(lines) + "\n}\n")
            part.replace(self._path)
            print(name, json.dumps(figures), flush=True)


def play_together(rows, case, players, *settings):
    """Plays the rows of a case at the same time, each on a link of its own."""

    def play_row(player):
        rows.add(f"{case.name}: {player}", play(case, player, *settings))

    with concurrent.futures.ThreadPoolExecutor() as pool:
        list(pool.map(play_row, players))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=pathlib.Path, default=ROOT / "build/release/bin", help="folder of the programs")
    parser.add_argument("--json", type=pathlib.Path, default=BENCH / "beats.json", help="the finished rows")
    parser.add_argument("--pages", action="store_true", help="write the tables into the pages")
    parser.add_argument("--rows", default="", help="regular expression: the rows that are run, and no others")
    parser.add_argument("--seconds", type=float, default=16, help="length of a run without its cut")
    arguments = parser.parse_args()
    os.environ["SPIKESERVE_PROGRAM"] = str(arguments.bin / "spikeserve")
    rows, rival = Rows(arguments.json), python_with(*RIVAL)
    for case in CASES:
        names = {player: f"{case.name}: {player}" for player in case.players}
        if arguments.rows:
            players = [player for player, name in names.items() if re.search(arguments.rows, name)]
        else:
            players = [player for player, name in names.items() if name not in rows.finished and not case.on_request]
        play_together(rows, case, players, case.seconds or arguments.seconds, arguments.bin, rival)
    if arguments.pages:
        for path, text in pages(ROOT, rows.finished):
            path.write_text(text)


if __name__ == "__main__":
    main()
