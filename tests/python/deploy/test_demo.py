"""The demonstration: what it prints, the page that stays in a terminal, and the robots that keep playing; `make bench`."""

import json
import os
import pathlib
import pty
import re
import signal
import subprocess
import sys

from security import until
from serving import DEPLOY, SHIPPED_POLICIES, run
from test_watching import get

BIN = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent
MOST_LINES = 24  # after the build; the Makefile prints one more
WIDTH = 100
RESULT = [
    r"CartPole-v1 with policy cartpole/\d+ \(\w+\) \.{20}",
    r"mean return [\d.]+ \+- [\d.]+ over 20 episodes, \d+ decisions",
    r"spikes      [\d.]+ a decision",
    r"energy      [\d.]+ nJ a decision by the estimate int_sram_45nm, [\d.]+ nJ without memory \(int_45nm\)",
    r"latency     p50 [\d.]+ ms, p99 [\d.]+ ms, from the call to its answer",
    r"dense model [\d.]+ nJ a decision by int_sram_45nm, for the same size: \d+ times as much",
]


def check(lines):
    """Checks that the lines are what is served, the result, and up to two lines about what to do next."""
    served = " ".join(lines[: len(lines) - len(RESULT)])
    assert re.match(r"serving \d+ policies on 127\.0\.0\.1:\d+: .*\bcartpole/\d+\b", served)
    for line, expected in zip(lines[-len(RESULT) :], RESULT, strict=True):
        assert re.fullmatch(expected, line)
    for line in lines:
        assert len(line) <= WIDTH


def spikectl(server, *arguments):
    return server.spikectl(*arguments).stdout.splitlines()


def test_the_table_of_policies_fits_a_page(server):
    versions = [f"{path.parent.name}/{path.name}" for path in SHIPPED_POLICIES.glob("*/[0-9]*")]
    first, *rows = spikectl(server, "policies", "--all")
    assert first.split()[:2] == ["POLICY", "ENVIRONMENT"]
    assert sorted(row.split()[0] for row in rows) == sorted(versions)
    assert max(map(len, [first, *rows])) <= WIDTH

    _, *rows, more = spikectl(server, "policies")
    served = [row.split()[0].split("/") for row in rows]
    assert [name for name, _ in served] == sorted({version.split("/")[0] for version in versions})
    assert more == f"{len(versions) - len(rows)} more that new sessions do not get: --all lists them"

    spikectl(server, "admin", "label", "--policy=cartpole", "--version=1", "--label=old")
    assert [row.split()[-1] for row in spikectl(server, "policies") if row.startswith("cartpole/1 ")] == ["old"]
    spikectl(server, "admin", "unlabel", "--policy=cartpole", "--label=old")


def test_without_a_terminal_it_prints_the_result_and_ends():
    played = run(DEPLOY / "demo.sh", BIN, stdin=subprocess.DEVNULL)
    *lines, following = played.stdout.splitlines()
    assert len(lines) < MOST_LINES
    check(lines)
    assert "http://" not in played.stdout, "no page is left"
    assert following.startswith("next        make demo PLAY=1 ")
    assert played.stderr == ""


def test_in_a_terminal_the_page_stays_until_enter():
    terminal, inside = pty.openpty()
    demo = subprocess.Popen([DEPLOY / "demo.sh", BIN], stdin=inside, stdout=inside, start_new_session=True)
    os.close(inside)
    try:
        with os.fdopen(terminal, "r+b", buffering=0) as screen:
            lines = []
            while not lines or not lines[-1].startswith("next"):
                lines.append(screen.readline().decode().rstrip())
                assert lines[-1], "the demonstration ended early"
            check(lines[:-2])
            assert len(lines) <= MOST_LINES
            page = re.fullmatch(r"status page (http://\S+/) until you press Enter", lines[-2])[1]
            assert "<title>spikeserve" in get(page)
            counted = get(f"{page}metrics")
            assert set(re.findall(r'^spikeserve_decisions_total\{policy="(\S+?)".* [1-9]\d*$', counted, re.MULTILINE)) == {"cartpole"}
            screen.write(b"\n")
            assert demo.wait(60) == 0
    finally:
        if demo.poll() is None:
            os.killpg(demo.pid, signal.SIGKILL)


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


BENCH = pathlib.Path(__file__).parents[3] / "loadtest/bench.py"


def test_every_row_has_figures():
    programs = pathlib.Path(os.environ["SPIKESERVE_PROGRAM"]).parent
    lines = run(sys.executable, BENCH, f"--bin={programs}", "--seconds=0.2").stdout.splitlines()
    assert [line[:32].strip() for line in lines] == [
        *("policy cartpole", "engine, baseline", "engine, full", "memory, full"),
        *(f"server, {mode}, {count} sessions" for mode, count in (("unary", 1), ("unary", 64), ("stream", 64), ("batch", 64))),
    ]
    for line in [*lines[1:3], *lines[4:]]:
        assert float(re.search(r"([\d,]+)  ", line[32:])[1].replace(",", "")) > 0, line
    assert re.search(r"session [\d.]+ KiB, idle [\d.]+ KiB, engine 0\.\d+ MB$", lines[3])
