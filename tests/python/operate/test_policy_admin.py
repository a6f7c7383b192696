"""What an operator changes about the served policies, while agents play and over restarts of the server."""

import collections
import concurrent.futures
import json
import math
import shutil
import threading

import grpc
import pytest
from agent_streams import AgentStream
from security import ADMIN, HEALTH, OBSERVATION, POLICY, SERVING, code_of, fails_with, until
from serving import SHIPPED_POLICIES, Service, add_version, http_call, metric, refusal_at_start, running_server, series

INVALID = grpc.StatusCode.INVALID_ARGUMENT
NOT_FOUND = grpc.StatusCode.NOT_FOUND
PRECONDITION = grpc.StatusCode.FAILED_PRECONDITION
NOT_SERVING = 2  # HealthCheckResponse.NOT_SERVING
FILE = "policy.safetensors"


@pytest.fixture
def policies(tmp_path):
    """Makes a folder with two different versions of `robot`, and pendulum."""
    folder = tmp_path / "policies"
    for version in (1, 2):
        add_version(folder, "robot", version, SHIPPED_POLICIES / f"cartpole/{version}")
    add_version(folder, "pendulum", 1, SHIPPED_POLICIES / "pendulum/1")
    return folder


@pytest.fixture
def server(policies):
    with running_server(policies) as started:
        yield started


def load(server, version, **fields):
    server.admin.LoadPolicy(policy="robot", version=version, **fields)


def unload(server, version):
    server.admin.UnloadPolicy(policy="robot", version=version)


def label(server, name, version):
    server.admin.SetLabel(policy="robot", label=name, version=version)


def divide(server, shares, **fields):
    """Sets the traffic shares {version: percent}."""
    shares = [{"version": version, "percent": percent} for version, percent in shares.items()]
    server.admin.SetTraffic(policy="robot", shares=shares, **fields)


def opened(server, **fields):
    """Opens a session of the robot. Returns its version."""
    return server.agent.OpenSession(policy="robot", **fields).version


def versions(server):
    return [policy.version for policy in server.agent.ListPolicies().policies if policy.name == "robot"]


def session_of(server, **fields):
    return server.agent.OpenSession(policy="robot", **fields).session_id


def act(server, session, step=0):
    observation = [math.sin(0.7 * step + i) for i in range(4)]
    answer = server.agent.Act(session_id=session, step=step, observation=observation)
    return list(answer.action_probabilities)


def end(server, session):
    server.agent.EndEpisode(session_id=session, reward=1.0)


def test_new_sessions_get_the_new_version_and_running_ones_keep_theirs(server, policies):
    old = session_of(server)
    first = act(server, old)
    add_version(policies, "robot", 3)
    load(server, 3, make_default=True)
    assert opened(server) == 3
    unload(server, 2)
    # The session continues as one that is opened after its version was loaded again.
    load(server, 2)
    same = session_of(server, version=2)
    assert act(server, same) == first
    for step in range(1, 10):
        assert act(server, old, step) == act(server, same, step)


def test_reload_loads_new_files_and_drops_those_that_are_gone(server, policies):
    add_version(policies, "robot", 3)
    shutil.rmtree(policies / "robot/1")
    report = server.admin.ReloadPolicies()
    assert [each.version for each in report.loaded] == [3]
    assert [each.version for each in report.unloaded] == [1]
    assert versions(server) == [2, 3]
    assert not server.admin.ReloadPolicies().loaded


def test_a_bad_file_never_takes_a_good_one_down(server, policies):
    session = session_of(server)
    act(server, session)
    path = policies / "robot/2" / FILE
    good = path.read_bytes()
    path.write_bytes(b"garbage")
    [refused] = server.admin.ReloadPolicies().refused
    assert str(path) in refused
    with fails_with(INVALID, str(path)):
        load(server, 2)
    assert opened(server) == 2
    act(server, session, 1)
    path.write_bytes(good)
    assert not server.admin.ReloadPolicies().refused


def test_a_polled_directory_needs_no_operator(policies, tmp_path):
    log = tmp_path / "log"
    with running_server(policies, ["--poll_policies=10ms"], log=log) as server:
        garbage = tmp_path / "garbage"
        garbage.write_bytes(b"garbage")
        garbage.rename(policies / "robot/1" / FILE)  # the server cannot refuse a half-written file as well
        add_version(policies, "robot", 4)
        until(lambda: versions(server) == [1, 2, 4])
        shutil.rmtree(policies / "robot/4")
        until(lambda: versions(server) == [1, 2])
    lines = log.read_text()
    for what in ("loaded", "unloaded"):
        assert f' info policy {what} policy="robot/4"\n' in lines
    assert lines.count(f'policy refused error="{policies}/robot/1/{FILE}') == 1, lines


def test_a_version_that_is_in_use_stays(server, policies):
    server.admin.SetDefaultVersion(policy="robot", version=1)
    assert opened(server) == 1
    with fails_with(PRECONDITION, "which is the default"):
        unload(server, 1)
    server.admin.SetDefaultVersion(policy="robot", version=0)
    assert opened(server) == 2
    divide(server, {}, shadow_version=1)
    with fails_with(PRECONDITION, "the shadow"):
        unload(server, 1)
    divide(server, {})
    label(server, "stable", 1)
    with fails_with(PRECONDITION, "label stable"):
        unload(server, 1)
    shutil.rmtree(policies / "robot/1")
    [refused] = server.admin.ReloadPolicies().refused
    assert "the file is gone" in refused
    assert versions(server) == [1, 2]
    with fails_with(NOT_FOUND, "received 7"):
        unload(server, 7)


def test_an_unloaded_version_stays_away_until_it_is_loaded(server):
    unload(server, 1)
    assert not server.admin.ReloadPolicies().loaded
    assert versions(server) == [2]
    load(server, 1)
    assert versions(server) == [1, 2]
    assert opened(server) == 2


def test_the_default_is_unloaded_last(server):
    with fails_with(PRECONDITION, "which is the default"):
        unload(server, 2)
    unload(server, 1)
    unload(server, 2)
    assert versions(server) == []
    for version in (1, 2):
        load(server, version)
        assert opened(server) == 1


def test_labels_name_versions(server):
    label(server, "stable", 1)
    label(server, "canary", 2)
    assert [opened(server, version_label=name) for name in ("stable", "canary")] == [1, 2]
    label(server, "stable", 2)
    assert opened(server, version_label="stable") == 2
    with fails_with(NOT_FOUND, "canary, stable"):
        opened(server, version_label="beta")
    with fails_with(INVALID, "version_label"):
        opened(server, version_label="beta", version=1)


def test_traffic_is_divided_by_key(server):
    divide(server, {2: 20, 1: 80})
    keys = [f"robot-{i}" for i in range(500)]
    routes = {key: opened(server, routing_key=key) for key in keys}
    for key in keys[:20]:
        assert opened(server, routing_key=key) == routes[key]
    # The hash determines these counts, so that they are the same in every run.
    assert collections.Counter(routes.values())[1] == pytest.approx(400, abs=40)
    divide(server, {2: 40, 1: 60})  # a share that grows keeps the keys that it had
    assert {opened(server, routing_key=key) for key in keys if routes[key] == 2} == {2}
    divide(server, {1: 100})
    label(server, "canary", 2)
    assert opened(server, version=2) == opened(server, version_label="canary") == 2
    with fails_with(INVALID, "add up to 100, received 110"):
        divide(server, {1: 80, 2: 30})
    with fails_with(NOT_FOUND, "received 9"):
        divide(server, {1: 80, 9: 20})
    divide(server, {})
    assert opened(server) == 2


def test_a_key_falls_into_shares_of_two_policies_independently(server, policies):
    for version in (1, 2):
        add_version(policies, "other", version, policies / "robot/1")
    server.admin.ReloadPolicies()
    shares = [{"version": version, "percent": 50} for version in (1, 2)]
    for policy in ("robot", "other"):
        server.admin.SetTraffic(policy=policy, shares=shares)

    def version_of(policy, key):
        return server.agent.OpenSession(policy=policy, routing_key=key).version

    equal = sum(version_of("robot", f"{i}") == version_of("other", f"{i}") for i in range(300))
    assert equal == pytest.approx(150, abs=50)


def test_a_shadow_sees_the_traffic_and_answers_nobody(server, policies):
    """Version 3 is a copy of version 2; version 1 is a different policy."""
    add_version(policies, "robot", 3, policies / "robot/2")
    load(server, 3)
    plain = session_of(server, version=2)
    divide(server, {}, shadow_version=3)
    equal = session_of(server, version=2)
    divide(server, {}, shadow_version=1)
    other = session_of(server, version=2)
    shadow = session_of(server, version=1)  # a version does not shadow itself
    add_version(policies, "robot", 4, policies / "pendulum/1")
    load(server, 4)
    server.agent.Act(session_id=session_of(server, version=4), observation=[0.1] * 3)  # other spaces than the shadow's
    episodes, steps = 2, 25
    for _ in range(episodes):
        for step in range(steps):
            act(server, shadow, step)
            expected = act(server, plain, step)
            assert act(server, equal, step) == expected
            act(server, equal, step)  # a retry is not shadowed again
            assert act(server, other, step) == expected
        for session in (plain, equal, other, shadow):
            end(server, session)
    played = episodes * steps
    decisions, spikes = "spikeserve_shadow_decisions_total", "spikeserve_shadow_spikes_total"
    until(lambda: sum(series(server, decisions)) >= 2 * played)
    assert metric(server, decisions) == 2 * played
    assert metric(server, decisions, shadow_version="3", agreement="agree") == played
    assert metric(server, decisions, shadow_version="1", agreement="differ") > 0
    served, shadow = (metric(server, spikes, shadow_version="3", side=side) for side in ("served", "shadow"))
    assert served == shadow
    assert metric(server, "spikeserve_decisions_total") == 4 * played + 1
    assert not any(series(server, "spikeserve_shadow_dropped_total"))


def test_sessions_are_listed_by_pages(server):
    sessions = {session_of(server) for _ in range(5)}
    other = server.agent.OpenSession(policy="pendulum").session_id
    server.agent.Act(session_id=other, observation=OBSERVATION[:3])
    listed, token, pages = set(), "", 0
    while pages == 0 or token:
        page = server.admin.ListSessions(policy="robot", page_size=2, page_token=token)
        listed |= {session.session_id for session in page.sessions}
        assert page.open_sessions == 6
        token, pages = page.next_page_token, pages + 1
    assert (pages, listed) == (3, sessions)
    [session] = server.admin.ListSessions(policy="pendulum").sessions
    assert (session.session_id, session.step) == (other, 1)
    assert session.spikes > 0


def test_a_draining_server_finishes_what_it_has(server):
    health = Service(server.channel, HEALTH)

    def states():
        return [health.Check(service=service).status for service in ("", POLICY, ADMIN)]

    session = session_of(server)
    assert server.admin.Drain().open_sessions == 1
    assert states() == [NOT_SERVING, NOT_SERVING, SERVING]
    assert http_call(server.http, "GET", "/healthz")[2] == b"NOT_SERVING\n"
    with fails_with(grpc.StatusCode.UNAVAILABLE, "draining"):
        opened(server)
    act(server, session)
    server.admin.Drain(cancel=True)
    assert states() == [SERVING] * 3
    opened(server)


def test_swaps_under_64_running_streams_lose_no_call_and_no_session(server, policies):
    sessions = [session_of(server) for _ in range(64)]
    stopped = threading.Event()

    def play(session):
        """Plays a session on a stream of its own. Returns the number of answers."""
        stream, step = AgentStream(server.channel), 0
        while not stopped.is_set():
            answer = stream.act(session, step)
            assert (answer.step, answer.HasField("error")) == (step, False)
            step += 1
        stream.end()
        return step

    with concurrent.futures.ThreadPoolExecutor(len(sessions)) as threads:
        played = [threads.submit(play, session) for session in sessions]
        try:
            for version in range(3, 13):
                add_version(policies, "robot", version)
                load(server, version, make_default=True)
                assert opened(server) == version
                unload(server, version - 1)
                before = metric(server, "spikeserve_decisions_total")
                until(lambda: metric(server, "spikeserve_decisions_total") >= before + len(sessions))
        finally:
            stopped.set()
    assert metric(server, "spikeserve_decisions_total") == sum(each.result() for each in played)
    assert metric(server, "spikeserve_sessions", policy="robot", version="2") == len(sessions)
    for session in sessions:
        state = server.agent.GetSession(session_id=session)
        assert state.version == 2
        assert state.step > 0


@pytest.fixture
def settings(tmp_path):
    """Returns the path of a file of settings, in a folder of its own."""
    (tmp_path / "kept").mkdir()
    return tmp_path / "kept" / "settings.json"


def serving_with(settings, policies, log=None):
    return running_server(policies, [f"--policy_settings={settings}"], log=log)


def held(server):
    """Returns a text for each version of the robot with the operator's settings of it."""
    lines = []
    for policy in server.agent.ListPolicies().policies:
        if policy.name == "robot":
            words = [str(policy.version), *["default"] * policy.is_default, *policy.version_labels]
            lines.append(" ".join([*words, f"{policy.traffic_percent}%", *["shadow"] * policy.is_shadow]))
    return lines


def test_settings_outlive_the_server(policies, settings):
    for version in (3, 4):
        add_version(policies, "robot", version)
    keys = [f"robot-{i}" for i in range(20)]
    with serving_with(settings, policies) as server:
        server.admin.SetDefaultVersion(policy="robot", version=1)
        label(server, "stable", 1)
        label(server, "canary", 2)
        divide(server, {1: 80, 2: 20}, shadow_version=3)
        unload(server, 4)
        before = held(server)
        assert before == ["1 default stable 80%", "2 canary 20%", "3 0% shadow"]
        routes = [opened(server, routing_key=key) for key in keys]
    with serving_with(settings, policies) as server:
        assert held(server) == before
        assert [opened(server, routing_key=key) for key in keys] == routes
        load(server, 4)  # cancels the unload for all later restarts
    with serving_with(settings, policies) as server:
        assert len(held(server)) == 4


@pytest.mark.parametrize("path", ["no such folder/settings.json", "/proc/settings.json"])
def test_a_file_that_cannot_be_written_stops_the_start(policies, tmp_path, path):
    """Not even a superuser can create files in /proc."""
    path = tmp_path / path
    said = refusal_at_start(f"--policy_settings={path}", policies=policies)
    assert f"--policy_settings: expected a file in a directory that the server can write: {path}" in said


def test_what_cannot_be_written_down_is_not_set(policies, settings):
    with serving_with(settings, policies) as server:
        shutil.rmtree(settings.parent)
        with pytest.raises(grpc.RpcError, match=str(settings)):
            server.admin.SetDefaultVersion(policy="robot", version=1)
        assert code_of(unload, server, 1) != grpc.StatusCode.OK
        assert versions(server) == [1, 2]
        assert opened(server) == 2

        add_version(policies, "robot", 3)
        assert code_of(server.admin.LoadPolicy, policy="robot", version=3, make_default=True) != grpc.StatusCode.OK
        add_version(policies, "other", 1)
        assert str(settings) in str(server.admin.ReloadPolicies().refused)
        settings.parent.mkdir()
        server.admin.ReloadPolicies()
        assert (versions(server), opened(server)) == ([1, 2, 3], 2)
        assert json.loads(settings.read_text())["policies"]["other"]["default_version"] == 1


def test_a_setting_waits_for_a_version_that_is_not_there(policies, settings, tmp_path):
    add_version(policies, "robot", 3)
    with serving_with(settings, policies) as server:
        server.admin.SetDefaultVersion(policy="robot", version=2)
        label(server, "stable", 1)
        label(server, "canary", 2)
        divide(server, {1: 80, 2: 20}, shadow_version=2)
    away = (policies / "robot/2").rename(tmp_path / "away")
    log = tmp_path / "log"
    with serving_with(settings, policies, log) as server:
        assert held(server) == ["1 stable 0%", "3 default 0%"]
        for setting in ("default_version", "labels.canary", "shares"):
            waits = f"policies.robot.{setting}: waits for version 2, which is not served"
            assert f' warning setting pending setting="{settings}: {waits}' in log.read_text()
        assert len(server.admin.ReloadPolicies().waiting) == 4
        label(server, "stable", 3)  # discards none of the waiting ones, not even over another restart
    with serving_with(settings, policies) as server:
        away.rename(policies / "robot/2")
        assert not server.admin.ReloadPolicies().waiting
        assert held(server) == ["1 80%", "2 default canary 20% shadow", "3 stable 0%"]


def test_a_setting_waits_for_a_policy_that_is_not_there(policies, settings, tmp_path):
    with serving_with(settings, policies) as server:
        label(server, "stable", 1)
    away = (policies / "robot").rename(tmp_path / "away")
    for _ in range(2):
        with serving_with(settings, policies) as server:
            assert versions(server) == []
    with serving_with(settings, policies) as server:
        away.rename(policies / "robot")
        load(server, 1)
        assert held(server) == ["1 default stable 0%"]


def test_a_server_whose_last_version_was_unloaded_starts_again(policies, settings):
    shutil.rmtree(policies / "pendulum")
    with serving_with(settings, policies) as server:
        for version in (1, 2):
            unload(server, version)
    with serving_with(settings, policies) as server:
        assert versions(server) == []


def test_a_pause_outlives_the_server(policies, settings):
    def paused(server):
        heads = [("robot", 1), ("robot", 2), ("robot", 3), ("pendulum", 1)]
        return [server.admin.GetHead(policy=policy, version=version).paused for policy, version in heads]

    add_version(policies, "robot", 3)
    with serving_with(settings, policies) as server:
        server.admin.PauseLearning(policy="robot")
    with serving_with(settings, policies) as server:
        assert paused(server) == [True, True, True, False]
        server.admin.ResumeLearning()
    with serving_with(settings, policies) as server:
        assert not any(paused(server))
        server.admin.PauseLearning()
        assert all(paused(server))


MISTAKES = [
    ("{", "settings: "),
    ('{"policy": {}}', 'expected no other keys, received "policy"'),
    ('{"unloaded": {"p": 1}}', "unloaded.p: expected an array"),
    ('{"unloaded": {"p": [0]}}', "unloaded.p: expected an integer of at least 1"),
]
MISTAKES_OF_A_POLICY = [
    ([], ": expected an object, received an array of 0"),
    ({"defualt_version": 1}, ': expected no other keys, received "defualt_'),
    ({"default_version": 0}, ".default_version: expected an integer of at least"),
    ({"default_version": "1"}, ".default_version: expected an integer of at"),
    (
        {"default_version": 1, "default_follows_highest": True},
        ".default_version: expected none beside default_follows_highest, received 1",
    ),
    ({"shadow_version": 1.5}, ".shadow_version: expected an integer of at least"),
    ({"learning_paused": 1}, ".learning_paused: expected true or false"),
    ({"labels": {"a b": 1}}, ".labels: expected letters, digits"),
    ({"labels": {"a": -1}}, ".labels.a: expected an integer of at least 1"),
    ({"shares": {}}, ".shares: expected an array, received an object"),
    (
        {"shares": [{"version": 1, "percent": 101}]},
        ".shares[0].percent: expected an integer from 0 to 100, received 101",
    ),
    ({"shares": [{"version": 1, "percent": 60}]}, ".shares: expected percents that add up to 100, received 60"),
    ({"shares": [{"version": 1, "percent": 50}] * 2}, ".shares: expected each version once, received 1 twice"),
]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *MISTAKES,
        *((json.dumps({"policies": {"p": policy}}), f"policies.p{message}") for policy, message in MISTAKES_OF_A_POLICY),
    ],
)
def test_a_mistake_in_the_file_keeps_the_server_from_starting(policies, settings, text, message):
    settings.write_text(text)
    said = refusal_at_start(f"--policy_settings={settings}", policies=policies)
    assert f"--policy_settings: {settings}: " in said
    assert message in said
