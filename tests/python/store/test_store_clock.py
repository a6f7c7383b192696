"""A time of day that jumps makes no session of a file store older."""

import contextlib
import itertools

import pytest
from machine import Clock
from security import until
from stored_sessions import Restartable, acting, comparable, opening, undisturbed_answers

IDLE = range(8)
DAY = 86400


@pytest.fixture
def clock(tmp_path):
    return Clock(tmp_path)


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_answers(IDLE)


@contextlib.contextmanager
def server_with(clock, tmp_path):
    """Yields a server on a file store whose sessions have decided once, and its log."""
    with (tmp_path / "log").open("w+") as log:
        with Restartable(f"file:{tmp_path}/store", log=log, prefix=clock.prefix) as server:
            for i in IDLE:
                server.OpenSession(**opening(i))
                server.Act(**acting(i, 0, 0))
            yield server, lambda: (tmp_path / "log").read_text()


@pytest.mark.parametrize("jump", [25 * 3600, -56 * 365 * DAY, 400 * DAY])
def test_a_clock_that_has_jumped_when_the_server_starts(clock, tmp_path, undisturbed, jump):
    with server_with(clock, tmp_path) as (server, log):
        server.kill()
        clock.jump(jump)
        server.restart()
        for i in IDLE:
            assert comparable(server.Act(**acting(i, 0, 1))) == undisturbed[i][1]
        assert "time of day differs from that of the last record in the session store" in log()
        server.kill()
        clock.jump(-jump)
        server.restart()
        for i in IDLE:
            assert comparable(server.Act(**acting(i, 0, 2))) == undisturbed[i][2]


def test_a_clock_that_jumps_while_the_server_runs(clock, tmp_path, undisturbed):
    """One session is used afterwards; the others are as old as before."""
    used, *idle = IDLE
    with server_with(clock, tmp_path) as (server, log):
        clock.jump(25 * 3600)
        steps = itertools.count(1)
        # Abseil looks at the clock every few seconds.
        until(lambda: server.Act(**acting(used, 0, next(steps))) and "time of day has jumped" in log())
        server.restart()
        for i in idle:
            assert comparable(server.Act(**acting(i, 0, 1))) == undisturbed[i][1]
