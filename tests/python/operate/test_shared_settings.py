"""Replicas share the settings of operators and promoted versions."""

import contextlib
import json
import re
import shutil
import urllib.request
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from redis_servers import WITHOUT_REDIS, Redis, stopping
from security import HEALTH, SERVING, code_of, entry, fails_with, service_with, until
from serving import SHIPPED_POLICIES, Service, run, series, status_of
from stored_sessions import Restartable, comparable, learn

pytestmark = WITHOUT_REDIS


@pytest.fixture
def redis():
    with stopping([Redis(password="")]) as [started]:
        yield started


@pytest.fixture
def start(redis, tmp_path):
    """Returns a function that starts a replica with its own folder of policies."""
    with contextlib.ExitStack() as started:

        def start_one(name, *flags):
            for policy in ("cartpole", "pendulum"):
                shutil.copytree(SHIPPED_POLICIES / policy, tmp_path / name / policy)
            replica = Restartable(f"redis://127.0.0.1:{redis.port}", flags, tmp_path / name)
            return started.enter_context(replica)

        yield start_one


def opened_version(replica, **fields):
    return replica.OpenSession(policy="cartpole", **fields).version


def health_of(replica):
    return Service(replica.channel, HEALTH).Check(service="").status


def test_a_change_on_one_replica_reaches_all(start):
    first, second = start("a"), start("b")
    first.admin.SetDefaultVersion(policy="cartpole", version=1)
    until(lambda: opened_version(second) == 1)
    second.admin.SetLabel(policy="cartpole", version=2, label="canary")
    until(lambda: code_of(first.OpenSession, policy="cartpole", version_label="canary") == grpc.StatusCode.OK)
    assert opened_version(first, version_label="canary") == 2
    first.admin.SetTraffic(
        policy="cartpole", shares=[{"version": 1, "percent": 0}, {"version": 2, "percent": 100}], shadow_version=1
    )
    until(lambda: opened_version(second) == 2)
    second.admin.PauseLearning(policy="cartpole")
    until(lambda: first.admin.GetHead(policy="cartpole").paused)
    second.admin.UnloadPolicy(policy="pendulum", version=1)
    missing = grpc.StatusCode.NOT_FOUND
    until(lambda: code_of(first.OpenSession, policy="pendulum", version=1) == missing)
    # The series of its log of heads is gone, too.
    until(lambda: series(second, "spikeserve_head_log_position", policy="pendulum") == [])
    assert len(series(second, "spikeserve_head_log_position")) == 2
    first.admin.LoadPolicy(policy="pendulum", version=1)
    until(lambda: code_of(second.OpenSession, policy="pendulum", version=1) == grpc.StatusCode.OK)


def test_changes_at_the_same_time_are_all_made(start):
    """Each replica sets labels as fast as it can. None overwrites those of the others."""
    replicas = [start(name) for name in "abc"]

    def set_labels(n):
        operator = replicas[n].admin
        for i in range(20):
            operator.SetLabel(policy="cartpole", version=1, label=f"label-{n}-{i}")

    with ThreadPoolExecutor() as pool:
        list(pool.map(set_labels, range(3)))
    labels = {f"label-{n}-{i}" for n in range(3) for i in range(20)}
    for replica in replicas:
        until(
            lambda replica=replica: all(
                code_of(replica.OpenSession, policy="cartpole", version_label=label) == grpc.StatusCode.OK
                for label in labels
            )
        )


def test_a_new_replica_takes_over_the_settings_before_it_serves(start):
    first = start("a")
    first.admin.SetDefaultVersion(policy="cartpole", version=1)
    second = start("b")
    assert health_of(second) == SERVING
    assert opened_version(second) == 1
    until(lambda: [status_of(each)["replicas"] for each in (first, second)] == [2, 2])
    names = {status_of(each)["replica"] for each in (first, second)}
    assert len(names) == 2
    assert status_of(first)["store"].startswith("redis://127.0.0.1:")
    second.kill()
    until(lambda: status_of(first)["replicas"] == 1)


def test_a_replica_without_settings_does_not_serve(redis, start):
    redis.kill()
    replica = start("a")
    assert health_of(replica) == 2  # NOT_SERVING
    assert code_of(replica.admin.SetDefaultVersion, policy="cartpole", version=1) == grpc.StatusCode.UNAVAILABLE
    redis.start()
    until(lambda: health_of(replica) == SERVING)


def test_a_replica_without_policies_serves(redis, tmp_path):
    (tmp_path / "none").mkdir()
    store = f"redis://127.0.0.1:{redis.port}"
    with Restartable(store, ["--allow_no_policies"], tmp_path / "none") as replica:
        until(lambda: health_of(replica) == SERVING)


def test_redis_loses_the_settings(redis, start):
    """The replicas write what they have."""
    first, second = start("a"), start("b")
    first.admin.SetDefaultVersion(policy="cartpole", version=1)
    until(lambda: opened_version(second) == 1)
    redis.command("FLUSHALL")
    until(lambda: redis.command("HGET cfg revision") is not None)
    assert opened_version(start("c")) == 1


def test_redis_loses_a_change(redis, start):
    """It starts again from an older file. The replicas write what they have followed, such as a hold."""
    first, second = start("a"), start("b")
    assert redis.command("COPY cfg older") == 1
    first.admin.HoldSessions(id="fire", selection={"all": True})
    until(lambda: [each.hold.id for each in second.admin.ListHolds().holds] == ["fire"])
    followed = int(redis.command("HGET cfg revision"))
    assert redis.command("COPY older cfg REPLACE") == 1
    until(lambda: int(redis.command("HGET cfg revision")) > followed)
    for replica in (first, second, start("c")):
        assert [each.hold.id for each in replica.admin.ListHolds().holds] == ["fire"]


def test_redis_gives_a_lost_revision_to_another_change(redis, start):
    """The replica that had made the lost one takes the other one over."""
    first, second = start("a"), start("b")
    assert redis.command("COPY cfg other") == 1
    first.admin.SetDefaultVersion(policy="cartpole", version=1)
    until(lambda: opened_version(second) == 1)
    script = "redis.call('HSET', 'cfg', 'settings', redis.call('HGET', 'other', 'settings'))"
    redis.command(f'EVAL "{script}" 0')
    for replica in (first, second):
        until(lambda each=replica: opened_version(each) == 2)


def test_settings_lost_while_no_replica_lives(redis, start, tmp_path):
    """The next server says that it begins with the defaults."""
    first = start("a")
    first.admin.SetDefaultVersion(policy="cartpole", version=1)
    first.kill()
    redis.command("FLUSHALL")
    first.log = tmp_path / "log"
    first.restart()
    until(lambda: redis.command("HGET cfg revision") == b"1")
    line = next(line for line in first.log.read_text().splitlines() if "has no settings" in line)
    assert 'settings="defaults"' in line
    assert opened_version(first) == 2


def test_a_promoted_version_travels(start):
    first, second = start("a"), start("b")
    learn(first)
    promoted = first.admin.PromoteHead(policy="cartpole", make_default=True)
    assert promoted.version == 3
    until(lambda: opened_version(second) == 3)
    files = [each.policies / "cartpole" / "3" / "policy.safetensors" for each in (first, second)]
    assert files[0].read_bytes() == files[1].read_bytes()

    # A session of the new version continues elsewhere, and one that joins later has it.
    session = first.OpenSession(policy="cartpole", durability="SYNC").session_id
    answer = first.Act(session_id=session, observation=[0.1] * 4)
    first.kill()
    assert comparable(second.Act(session_id=session, observation=[0.1] * 4)) == comparable(answer)
    assert opened_version(start("c")) == 3


def test_a_replica_that_cannot_write_what_was_promoted_tries_again(start):
    first, second = start("a"), start("b")
    in_its_place = second.policies / "cartpole" / "3"
    in_its_place.write_text("no folder")
    learn(first)
    assert first.admin.PromoteHead(policy="cartpole").version == 3
    first.admin.SetLabel(policy="cartpole", version=1, label="later")
    until(lambda: code_of(second.OpenSession, policy="cartpole", version_label="later") == grpc.StatusCode.OK)
    in_its_place.unlink()
    until(lambda: code_of(second.OpenSession, policy="cartpole", version=3) == grpc.StatusCode.OK)


def test_a_replica_that_cannot_read_its_folder_tries_again(start, tmp_path):
    first, second = start("a"), start("b")
    away = second.policies.rename(tmp_path / "away")
    assert opened_version(second) == 2
    first.admin.SetDefaultVersion(policy="cartpole", version=1)
    with pytest.raises(grpc.RpcError):  # asks the store for settings, and takes those over
        second.admin.SetLabel(policy="cartpole", version=1, label="never")
    away.rename(second.policies)
    until(lambda: opened_version(second) == 1)


def test_a_shared_setting_is_in_force_without_its_copy(start, tmp_path):
    copies = tmp_path / "settings"
    copies.mkdir()
    first, second = start("a", f"--policy_settings={copies}/a.json"), start("b")
    shutil.rmtree(copies)
    for version, label in ((1, "x"), (2, "y")):
        first.admin.SetLabel(policy="cartpole", version=version, label=label)
    for replica in (first, second):
        named = {"policy": "cartpole", "version_label": "y"}
        until(lambda each=replica: code_of(each.OpenSession, **named) == grpc.StatusCode.OK)
        assert opened_version(replica, version_label="x") == 1


def test_two_replicas_promote_at_the_same_time(start):
    replicas = [start("a"), start("b")]
    for replica in replicas:
        learn(replica)
    with ThreadPoolExecutor() as pool:
        promoted = list(pool.map(lambda each: each.admin.PromoteHead(policy="cartpole"), replicas))
    assert sorted(each.version for each in promoted) == [3, 4]
    for replica in replicas:
        for version in (3, 4):
            until(
                lambda replica=replica, version=version: (
                    code_of(replica.OpenSession, policy="cartpole", version=version) == grpc.StatusCode.OK
                )
            )
    files = [[each.policies / "cartpole" / str(version) for each in replicas] for version in (3, 4)]
    for ours, theirs in files:
        assert (ours / "policy.safetensors").read_bytes() == (theirs / "policy.safetensors").read_bytes()


def test_other_bytes_of_a_version(start, tmp_path):
    """A replica whose file of a version differs does not continue with its sessions, and says so."""
    first = start("a")
    shutil.copytree(SHIPPED_POLICIES / "cartpole", tmp_path / "other" / "cartpole")
    file = tmp_path / "other" / "cartpole" / "2" / "policy.safetensors"
    shutil.copy(SHIPPED_POLICIES / "cartpole" / "1" / "policy.safetensors", file)
    session = first.OpenSession(policy="cartpole", version=2, durability="SYNC").session_id
    second = start("b")
    second.policies = tmp_path / "other"
    second.restart()
    with fails_with(grpc.StatusCode.UNAVAILABLE) as error:
        second.Act(session_id=session, observation=[0.0] * 4)
    assert error.value.details() == (
        "session_id: expected a session whose policy this server has, received one of cartpole version 2, "
        "whose file is another one here"
    )
    # The second replica has taken the session over in vain. The first one finds that out, and takes it back.
    until(lambda: code_of(first.Act, session_id=session, observation=[0.0] * 4) == grpc.StatusCode.OK)


def spikectl(replicas, *arguments):
    """Runs `spikectl admin` on all replicas. Returns its exit status, its rows by address, and its error."""
    addresses = [replica.addresses.grpc for replica in replicas]
    finished = run("spikectl", "admin", *arguments, f"--server={','.join(addresses)}", "--json", status=None)
    rows = json.loads(finished.stdout)["servers"]
    assert [row["server"] for row in rows] == addresses
    return finished.returncode, rows, finished.stderr


def add_version_3(replica):
    shutil.copytree(SHIPPED_POLICIES / "cartpole/1", replica.policies / "cartpole" / "3")


def test_a_rollout_is_refused_while_a_live_replica_lacks_the_version(start):
    replicas = [start(name) for name in "abc"]
    until(lambda: [status_of(each)["replicas"] for each in replicas] == [3, 3, 3])
    for replica in replicas[:2]:
        add_version_3(replica)
    rollout = ("rollout", "--policy=cartpole", "--version=3", "--steps=10,50")
    status, rows, error = spikectl(replicas, "load", "--policy=cartpole", "--version=3")
    assert status == 1
    assert [row.get("code") for row in rows] == [None, None, "NOT_FOUND"]
    assert f"1 of 3 servers failed: {rows[2]['server']}" in error
    status, rows, error = spikectl(replicas, *rollout)
    assert status == 1
    lacking = status_of(replicas[2])["replica"]
    expected = f"version: expected one that every live server serves, received 3, which 1 of 3 lack, or have another file of: {lacking};"
    assert [row["code"] for row in rows] == ["FAILED_PRECONDITION", "FAILED_PRECONDITION", "NOT_FOUND"]
    assert rows[0]["error"].startswith(expected), rows
    status, rows, _ = spikectl(replicas, "traffic", "--policy=cartpole", "--shares=2:90,3:10")
    assert (status, rows[0]["error"].startswith(expected)) == (1, True)
    assert all(opened_version(each) == 2 for each in replicas)
    # Another file of the same number is not the version either.
    shutil.copytree(SHIPPED_POLICIES / "cartpole/2", replicas[2].policies / "cartpole" / "3")
    assert spikectl(replicas, "reload")[0] == 0
    assert spikectl(replicas, *rollout)[0] == 1
    shutil.rmtree(replicas[2].policies / "cartpole" / "3")
    add_version_3(replicas[2])
    assert spikectl(replicas, "load", "--policy=cartpole", "--version=3")[0] == 0
    status, rows, error = spikectl(replicas, *rollout)
    assert (status, error) == (0, "")
    assert rows[0]["state"] == "running"
    assert [row["shared_by"] for row in rows[1:]] == [rows[0]["server"]] * 2
    # A dead one does not serve anything, so it need not have the version.
    assert spikectl(replicas, "rollout", "--policy=cartpole", "--abort")[0] == 0
    add_version_4 = replicas[:2]
    for replica in add_version_4:
        shutil.copytree(SHIPPED_POLICIES / "cartpole/1", replica.policies / "cartpole" / "4")
    assert spikectl(replicas[:2], "load", "--policy=cartpole", "--version=4")[0] == 0
    replicas[2].kill()
    until(lambda: status_of(replicas[0])["replicas"] == 2)
    assert spikectl(replicas[:2], "rollout", "--policy=cartpole", "--version=4")[0] == 0


def test_a_step_that_redis_has_taken_without_an_answer_is_held(redis, start):
    server = start("a")
    server.admin.StartRollout(policy="cartpole", version=1, steps=[10, 50], hold_seconds=600)

    def seconds_left():
        [rollout] = server.admin.ListRollouts().rollouts
        minutes, seconds = re.match(r"waits for (?:(\d+)m)?(?:(\d+)s)?", rollout.reason).groups(default="0")
        return rollout.step, 60 * int(minutes) + int(seconds)

    until(lambda: seconds_left() < (0, 597))
    script = (
        "local found = redis.call('HGET', 'cfg', 'settings') "
        r"local changed = string.gsub(found, '\"step\": 0', '\"step\": 1') "
        "redis.call('HSET', 'cfg', 'settings', changed) return redis.call('HINCRBY', 'cfg', 'revision', 1)"
    )
    assert isinstance(redis.command(f'EVAL "{script}" 0'), int)
    until(lambda: seconds_left() > (1, 597))


def test_a_server_that_died_before_the_clock_of_redis_was_set_back(redis, start):
    start("a")
    later = int(redis.command("TIME")[0]) * 1000 + 3_600_000
    assert redis.command(f"ZADD r {later} dead") == 1
    until(lambda: b"dead" not in redis.command("ZRANGE r 0 -1"))


def test_limits_are_divided(start, tmp_path):
    """Of a limit for a tenant, each of two replicas has half, so that the second decision waits twice as long."""
    tokens = tmp_path / "tokens.json"
    slow = {"slow": {"decisions_per_second": 0.001}}
    entries = [entry("agent", "agent", "slow"), entry("viewer", "viewer", "slow")]
    tokens.write_text(json.dumps({"tenants": slow, "tokens": entries}))
    _, second = (start(name, f"--tokens={tokens}") for name in "ab")
    header = {"Authorization": "Bearer viewer"}

    def replicas():
        request = urllib.request.Request(f"http://{second.addresses.http}/status.json", headers=header)
        with urllib.request.urlopen(request) as page:
            return json.load(page)["replicas"]

    until(lambda: replicas() == 2)
    with service_with(second.addresses, "agent") as service:
        session = service.OpenSession(policy="cartpole").session_id
        service.Act(session_id=session, observation=[0.0] * 4)
        with fails_with(grpc.StatusCode.RESOURCE_EXHAUSTED) as error:
            service.Act(session_id=session, step=1, observation=[0.0] * 4)
    assert int(re.search(r"try again in (\d+)m", error.value.details())[1]) > 20
