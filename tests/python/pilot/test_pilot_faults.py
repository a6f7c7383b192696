"""A robot whose senses, clocks or servers fail: docs/reference/beats.md has the rules of a pilot."""

import contextlib
import itertools
import math
import signal
from dataclasses import replace

import numpy as np
import pytest
import spikeserve
from redis_servers import WITHOUT_REDIS
from restartable_server import RestartableServer, restartable_server
from security import until
from serving import metric, running_server, series
from spikeserve.piloting import robot_clock
from test_pilot import LEARNING, WAIT, Flight, client, fly  # noqa: F401


def test_a_server_that_denies_the_session_has_not_the_last_word(tmp_path, fly):
    """The other server has its own store, as one that has lost the session would say."""
    options = spikeserve.SessionOptions(durability="ASYNC")
    servers = [RestartableServer(f"--session_store=file:{tmp_path}/{i}", http=True) for i in range(2)]
    with contextlib.ExitStack() as stack:
        for server in servers:
            stack.callback(server.kill)
            server.start()
        client = stack.enter_context(spikeserve.Client(",".join(server.address for server in servers)))
        with fly(client, local=False, session=options) as flight:
            flight.until("fresh")
            first = flight.pilot.session_id
            [owner] = [each for each in servers if series(each.server, "spikeserve_sessions")]
            [other] = [server for server in servers if server is not owner]
            owner.stop()
            refused = {"code": "NOT_FOUND", "method": "ActStream"}
            flight.fly_until(lambda: any(series(other.server, "spikeserve_rpc_duration_seconds_count", **refused)))
            owner.resume()
            flight.until("fresh")
            flight.end()
            flight.check_summaries()
            assert flight.pilot.session_id == first
            assert flight.pilot.stats().reopened == 0


@WITHOUT_REDIS
def test_what_a_kill_loses_the_robot_sends_again(redis, fly):
    """ASYNC: two ends of episodes were answered and never stored, nor was what was executed around them."""
    options = replace(LEARNING, durability="ASYNC")
    with restartable_server(f"--session_store=redis://127.0.0.1:{redis.port}") as server:
        with spikeserve.Client(server.address) as client, fly(client, "cartpole", local=False, session=options) as flight:
            for _ in range(2):
                flight.until("fresh")
                flight.fly(10)
                redis.process.send_signal(signal.SIGSTOP)
                for _ in range(2):
                    flight.fly(5)
                    flight.until("fresh")
                    flight.end()
                flight.until("fresh")
                for summary in flight.summaries:
                    summary.result(WAIT)
                server.kill()
                redis.kill()  # with what has arrived since it stopped
                flight.until("safe")
                redis.start()
                server.start()
            flight.until("fresh")
            flight.end()
            flight.check_session(client)
            stats = flight.pilot.stats()
            assert stats.reopened == stats.lost_episodes == 0


@WITHOUT_REDIS
def test_an_episode_of_a_fleet_ends_behind_a_step_that_saw_nothing(redis, fly):
    """A call ends the episodes of a head that a store keeps, but no server takes such a step without the end."""
    fleet = replace(LEARNING.learning, scope="FLEET")
    options = replace(LEARNING, durability="ASYNC", learning=fleet)
    with restartable_server(f"--session_store=redis://127.0.0.1:{redis.port}") as server:
        with spikeserve.Client(server.address) as client, fly(client, "cartpole", local=False, session=options) as flight:
            for blind in (0, 1, 2):
                flight.until("fresh")
                flight.fly(3)
                flight.blind(blind)
                flight.end()
            flight.until("fresh")
            flight.check_summaries()
            assert flight.pilot.stats().lost_episodes == 0


def test_a_blind_robot_is_not_reported_fresh(fly):
    with running_server() as server, spikeserve.Client(server.grpc) as client:
        with fly(client, local=False) as flight:
            for wrong in ([math.nan] * 3, [0.1, 0.2], [0.1, math.nan, 0.2]):
                flight.until("fresh")
                fresh = flight.pilot.stats().fresh
                actions = flight.blind(25, wrong)
                sources = [action.source for action in actions]
                held = sources.index("safe")
                assert held <= 3 and sources == ["held"] * held + ["safe"] * (25 - held)
                assert all(one.age < other.age for one, other in itertools.pairwise(actions))
                assert flight.pilot.stats().fresh == fresh
            stats = flight.pilot.stats()
            assert stats.invalid_observations == 75
            assert stats.last_invalid_observation == "observation[1]: expected a finite number, received nan"
            flight.until("fresh")
            flight.end()
            flight.check_summaries()
            assert stats.reopened == stats.lost_episodes == 0
            flight.fly_until(lambda: metric(server, "spikeserve_invalid_observations_total", policy="pendulum") == 75)


def test_a_server_hears_of_a_robot_that_stays_blind(fly):
    with running_server() as server, spikeserve.Client(server.grpc) as client:
        with fly(client, local=False) as flight:
            flight.until("fresh")
            until(lambda: flight.blind(1) and metric(server, "spikeserve_invalid_observations_total", policy="pendulum") >= 2)
            flight.end()
            flight.check_summaries()


def test_episodes_begin_and_end_without_an_observation(client, link, fly):
    with fly(client, local=False) as flight:
        flight.until("fresh")
        for _ in range(2):
            flight.blind(4)
            flight.end()
            flight.blind(3)
            flight.fly(2)
            link.cut()
            flight.blind(5)
            flight.fly(5)
            flight.blind(2)
            flight.end()
            flight.fly(3)
            link.heal()
            flight.until("fresh")
        flight.blind(1)
        flight.end()
        flight.check_summaries()
        stats = flight.pilot.stats()
        assert stats.reopened == stats.lost_episodes == stats.failures == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ([0.1, 0.2], "observation: expected 3 numbers, received 2"),
        ([0.1, math.nan, 0.2], r"observation\[1\]: expected a finite number, received nan"),
    ],
)
def test_a_robot_that_is_wired_wrong_hears_it_at_its_first_step(client, fly, wrong, message):
    with fly(client, local=False) as flight:
        for _ in range(2):
            with pytest.raises(ValueError, match=message):
                flight.pilot.beat(wrong)
        assert flight.pilot.stats().beats == 0
        flight.until("fresh")


@pytest.mark.parametrize(
    ("wrong", "received"),
    [({"a": 1.0}, "dict"), ("x", "str"), (None, "NoneType"), ([[0.0] * 3], "list")],
)
def test_what_is_no_row_of_numbers_is_no_observation(client, wrong, received):
    with Flight(client, local=False) as flight:
        with pytest.raises(ValueError, match=f"observation: expected 3 numbers, received {received}"):
            flight.pilot.beat(wrong)
        flight.until("fresh")
        flight.blind(5, wrong)
        assert flight.pilot.stats().invalid_observations == 5


def test_the_fall_back_hears_of_a_robot_that_is_blind(client):
    seen = []

    def fallback(observation):
        seen.append(observation)
        return [0.5]

    with Flight(client, local=False, hold_beats=0, ramp_beats=0, fallback=fallback) as flight:
        flight.until("fresh")
        seen.clear()
        assert [action.action.tolist() for action in flight.blind(3)] == [[0.5]] * 3
        assert len(seen) == 3 and np.isnan(seen).all()


@pytest.mark.parametrize("action", [math.nan, -0.7, 0.5])
def test_a_number_that_is_no_index_is_no_action(client, action):
    options = {"hold_beats": 0, "ramp_beats": 0, "fallback": lambda _: action}
    with Flight(client, "cartpole", local=False, **options) as flight:
        flight.until("fresh")
        flight.blind(3)
        stats = flight.pilot.stats()
        assert stats.failures == stats.safe >= 3


def test_a_robot_may_wait_until_an_answer_is_there(client, link, fly):
    with fly(client, local=False) as flight:
        link.delay = 0.1
        assert not flight.pilot.wait_ready(0.0)
        assert flight.beat().source == "safe"
        assert flight.pilot.wait_ready(WAIT)
        assert flight.beat().source == "fresh"


@pytest.mark.parametrize("seconds", [1, 5, 15])
def test_a_clock_that_stood_still_costs_no_second(client, monkeypatch, seconds):
    """A robot whose clock does not count its sleep, such as one of an earlier release."""
    with Flight(client, local=False, max_age=0.25) as flight:
        flight.until("fresh")
        flight.fly(20)
        now_ns = robot_clock.now_ns
        monkeypatch.setattr(robot_clock, "now_ns", lambda: now_ns() - int(seconds * 1e9))
        fresh = [flight.beat().source == "fresh" for _ in range(200)]
        assert any(fresh[100:])  # within two seconds; the measure of a server holds for 10 to 20
