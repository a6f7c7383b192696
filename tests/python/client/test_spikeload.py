"""`spikeload` with a real server."""

import json

import pytest
from serving import SHIPPED_POLICIES, add_version, metric, run, running_server, series

SHORT = ("--duration=500ms", "--episode_steps=10")


@pytest.fixture
def server(tmp_path):
    """Starts a server that has counted nothing yet, with three small policies of several spaces."""
    for policy in ("cartpole-small", "mountaincar", "pendulum"):
        add_version(tmp_path, policy, 1, SHIPPED_POLICIES / policy / "1")
    with running_server(tmp_path) as started:
        yield started


def spikeload(server, *flags, **options):
    return run("spikeload", f"--server={server.grpc}", *flags, **options)


def assert_one_line(server, message, *flags):
    finished = spikeload(server, *flags, status=1)
    assert finished.stdout == ""
    assert message in finished.stderr
    assert finished.stderr.count("\n") == 1, finished.stderr


def test_every_mode_runs_without_errors(server):
    total = 0
    for mode in ("unary", "stream", "batch"):
        flags = ("--policy=cartpole-small", f"--mode={mode}", "--sessions=20", "--streams=4", *SHORT, "--json")
        load = json.loads(spikeload(server, *flags).stdout)
        assert (len(load), load["errors"]) == (7, 0)
        assert load["decisions"] >= 20
        assert load["decisions_per_second"] > 0
        assert 0 < load["p50_seconds"] <= load["p99_seconds"]
        # Most sessions have a longest wait above the median of all waits.
        assert load["longest_wait_p50_seconds"] >= load["p50_seconds"]
        total += load["decisions"]
        assert metric(server, "spikeserve_decisions_total") == total
        assert metric(server, "spikeserve_sessions") == 0
    assert metric(server, "spikeserve_episodes_total") > 0


def test_policies_of_every_space_can_be_loaded(server):
    for policy in ("mountaincar", "pendulum"):
        load = spikeload(server, "--mode=batch", f"--policy={policy}", "--sessions=5", "--batch_size=2", "--duration=0.2")
        assert "\n0 errors\n" in load.stdout


def test_sessions_may_learn(server):
    updates = 0
    for scope in ("session", "fleet"):
        for policy in ("cartpole-small", "pendulum"):
            flags = ("--mode=stream", f"--policy={policy}", f"--learning_scope={scope}", "--sessions=8")
            spikeload(server, *flags, *SHORT)
            before, updates = updates, sum(series(server, "spikeserve_learning_updates_total"))
            assert updates > before, (scope, policy)


def test_it_says_in_one_line_what_is_wrong(server):
    for flag, message in (
        ("--learning_scope=town", '--learning_scope: expected session or fleet, received "town"'),
        ("--mode=pigeon", 'expected unary, stream or batch, received "pigeon"'),
        ("--sessions=0", "--sessions: expected 1 to 1000000, received 0"),
        ("--streams=0", "--streams"),
        ("--duration=soon", "expected a duration such as 250ms, 10s or 1.5m"),
        ("--duration=-1", "--duration"),
        ("--episode_steps=0", "--episode_steps"),
        ("--policy=nobody", '"nobody"'),
        ("now", 'expected flags alone, received "now"'),
    ):
        assert_one_line(server, message, flag)


def test_refused_sessions_and_a_server_that_is_gone_end_it(tmp_path):
    add_version(tmp_path, "cartpole")
    with running_server(tmp_path, ["--max_sessions=10"]) as server:
        assert_one_line(server, "RESOURCE_EXHAUSTED", "--sessions=11", "--streams=1", "--duration=100ms")
    assert_one_line(server, f"no server could be reached at {server.grpc}")
