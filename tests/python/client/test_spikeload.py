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
        ("--mode=Stream", 'expected unary, stream or batch, received "Stream"'),
        ("--sessions=0", "--sessions: expected 1 to 1000000, received 0"),
        ("--streams=0", "--streams: expected 1 to 1024, received 0"),
        ("--streams=2000", "--streams: expected 1 to 1024, received 2000"),
        ("--duration=soon", "expected a duration such as 250ms, 10s or 1.5m"),
        ("--duration=-1", "--duration"),
        ("--duration=inf", "--duration"),
        ("--call_timeout=0", "--call_timeout: expected more than 0 and at most 1h, received 0"),
        ("--episode_steps=0", "--episode_steps"),
        ("--batch_size=-1", "--batch_size"),
        ("--observation_bound=-1", "--observation_bound"),
        ("--rate=-1", "--rate"),
        ("--policy=nobody", '"nobody"'),
        ("now", 'expected flags alone, received "now"'),
    ):
        assert_one_line(server, message, flag)


def test_a_file_that_is_no_episode_is_refused_with_the_line(server, tmp_path):
    file = tmp_path / "episode.csv"
    for text in ("0,1\n0,1,2\n", "0,1\n3\n", "0,1\n0,one\n", "0,1\n\n"):
        file.write_text(text)
        assert_one_line(server, "episode.csv:2: expected", f"--observations={file}")
    file.write_text("")
    assert_one_line(server, "expected a line", f"--observations={file}")
    assert_one_line(server, "NOT_FOUND", f"--observations={tmp_path / 'missing'}")


def test_refused_sessions_end_it(tmp_path):
    add_version(tmp_path, "cartpole")
    with running_server(tmp_path, ["--max_sessions=10"]) as server:
        assert_one_line(server, "RESOURCE_EXHAUSTED", "--sessions=11", "--streams=1", "--duration=100ms")
