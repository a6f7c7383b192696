"""What operators do to a real server: loading without a new default, traffic, roll-outs and their history."""

import contextlib
import json
import os
import shutil

import grpc
import pytest
import serving
from made_policies import FAR, add_overflowing
from security import OBSERVATION, code_of, entry, tls_flags, until
from serving import SHIPPED_POLICIES, page_of, refusal_at_start, run, running_server

SPIKECTL = os.environ["SPIKECTL_PROGRAM"]


@pytest.fixture
def policies(tmp_path):
    """Returns a policy directory with version 1 of cartpole."""
    directory = tmp_path / "policies"
    add_version(directory, 1)
    return directory


def add_version(directory, version):
    """Adds a copy of the shipped policy as a version of cartpole."""
    serving.add_version(directory, "cartpole", version)


class Operated:
    """A running server, and what an operator and robots do with it."""

    def __init__(self, addresses, flags):
        self.addresses = addresses
        self._flags = flags

    def __getattr__(self, name):
        return getattr(self.addresses, name)

    def spikectl(self, *arguments):
        """Runs spikectl and returns its output."""
        return self.addresses.spikectl(*arguments, *self._flags).stdout

    def spikectl_json(self, *arguments):
        return json.loads(self.spikectl(*arguments, "--json"))

    def act_on(self, action, *arguments):
        """Runs an action of `spikectl admin` for cartpole and returns its JSON."""
        return self.spikectl_json("admin", action, "--policy=cartpole", *arguments)

    def opened_version(self, key=""):
        return self.agent.OpenSession(policy="cartpole", routing_key=key).version

    def play(self, episode_return):
        """Plays one episode of one step. Returns the version.

        `episode_return(version)` is its return. None: the version fails to decide.
        """
        opened = self.agent.OpenSession(policy="cartpole")
        reward = episode_return(opened.version)
        if reward is None:
            act = {"session_id": opened.session_id, "observation": FAR}
            assert code_of(self.agent.Act, **act) == grpc.StatusCode.INTERNAL
        else:
            self.agent.Act(session_id=opened.session_id, observation=OBSERVATION)
            self.agent.EndEpisode(session_id=opened.session_id, reward=reward, terminated=True)
        self.agent.CloseSession(session_id=opened.session_id)
        return opened.version

    def rollout(self):
        [rollout] = self.spikectl_json("admin", "rollouts")["rollouts"]
        return rollout

    def play_until(self, state, episode_return):
        """Plays until the roll-out of cartpole is in `state`, and returns it."""

        def reached():
            for _ in range(10):
                self.play(episode_return)
            return self.rollout()["state"] == state

        until(reached)
        return self.rollout()

    def get(self, path):
        return page_of(self.addresses, path)

    def traffic(self):
        """Returns the exported traffic share of each version."""
        shares = {}
        for line in self.get("/metrics").splitlines():
            if line.startswith("spikeserve_policy_traffic_ratio{"):
                labels, value = line.rsplit(" ", 1)
                shares[int(labels.split('version="')[1].split('"')[0])] = float(value)
        return shares


@contextlib.contextmanager
def operated(policies, *flags, client_flags=()):
    with running_server(policies, flags) as addresses:
        yield Operated(addresses, client_flags)


def served_versions(server):
    return [int(policy.version) for policy in server.agent.ListPolicies().policies]


def test_loading_leaves_the_default_and_make_default_moves_it(policies):
    add_version(policies, 2)
    with operated(policies) as server:
        assert server.opened_version() == 2  # the highest of those that were there at first
        add_version(policies, 3)
        loaded = server.act_on("load", "--version=3")
        assert loaded["is_default"] is False
        assert loaded["before"]["versions"] == [1, 2]
        assert loaded["after"]["versions"] == [1, 2, 3]
        assert loaded["before"]["default_version"] == loaded["after"]["default_version"] == 2
        assert server.opened_version() == 2
        assert server.act_on("load", "--version=3", "--make_default")["is_default"] is True
        assert server.opened_version() == 3
        assert server.act_on("default", "--version=0")["after"]["default_follows_highest"] is True
        add_version(policies, 4)
        assert server.act_on("load", "--version=4")["is_default"] is True


def test_the_poller_leaves_the_default(policies):
    with operated(policies, "--poll_policies=10ms") as server:
        add_version(policies, 2)
        until(lambda: served_versions(server) == [1, 2])
        assert server.opened_version() == 1
    with operated(policies, "--poll_policies=10ms", "--default_version=highest") as server:
        assert server.opened_version() == 2
        add_version(policies, 3)
        until(lambda: served_versions(server) == [1, 2, 3])
        assert server.opened_version() == 3


def test_a_restart_with_a_new_file_leaves_the_default(policies, tmp_path):
    settings = f"--policy_settings={tmp_path}/settings.json"
    with operated(policies, settings) as server:
        assert server.opened_version() == 1
    add_version(policies, 2)
    with operated(policies, settings) as server:
        assert served_versions(server) == [1, 2]
        assert server.opened_version() == 1


def test_shares_shadow_default_and_labels_are_changed_one_by_one(policies):
    add_version(policies, 2)
    with operated(policies) as server:
        server.act_on("label", "--version=1", "--label=stable")
        server.act_on("traffic", "--shares=1:95,2:5")
        changed = server.act_on("traffic", "--shadow=2")
        assert changed["before"]["shadow_version"] == 0
        shares = [{"version": 1, "percent": 95}, {"version": 2, "percent": 5}]
        expected = {
            "versions": [1, 2],
            "default_version": 2,
            "default_follows_highest": False,
            "labels": {"stable": 1},
            "shares": shares,
            "shadow_version": 2,
            "rollout_version": 0,
        }
        assert changed["after"] == expected
        assert server.act_on("traffic", "--shares=1:50,2:50")["after"]["shadow_version"] == 2
        assert server.act_on("traffic", "--shadow=0")["after"]["shares"] == [
            {"version": 1, "percent": 50},
            {"version": 2, "percent": 50},
        ]
        text = server.spikectl("admin", "traffic", "--policy=cartpole", "--shares=none")
        assert "before: versions 1, 2; default 2; shares 1:50, 2:50; no shadow; labels stable=1" in text
        assert "after:  versions 1, 2; default 2; no shares; no shadow; labels stable=1" in text


def test_traffic_shows_in_policies_metrics_and_the_status_page(policies):
    add_version(policies, 2)
    with operated(policies) as server:
        assert server.traffic() == {1: 0.0, 2: 1.0}
        server.act_on("label", "--version=1", "--label=stable")
        server.act_on("traffic", "--shares=1:95,2:5", "--shadow=2")
        rows = server.spikectl("policies").splitlines()
        assert rows[1].endswith("95% stable")
        assert rows[2].endswith("5% (shadow)")
        assert server.traffic() == {1: 0.95, 2: 0.05}
        metrics = server.get("/metrics")
        assert 'spikeserve_policy_label_info{policy="cartpole",version="1",label="stable"} 1' in metrics
        assert 'spikeserve_policy_shadow_info{policy="cartpole",version="2"} 1' in metrics
        status = json.loads(server.get("/status.json"))
        assert [policy["traffic_percent"] for policy in status["policies"]] == [95, 5]
        assert status["rollouts"] == []


def test_a_rollout_of_an_equal_version_ends_with_a_new_default(policies):
    add_version(policies, 2)
    with operated(policies) as server:
        server.act_on("default", "--version=1")
        started = server.act_on(
            "rollout", "--version=2", "--steps=50,100", "--hold=200ms", "--min_episodes=5"
        )
        assert started["state"] == "running"
        assert started["after"]["shares"] == [
            {"version": 2, "percent": 50},
            {"version": 1, "percent": 50},
        ]
        for refused in (server.admin.SetTrafficShares, server.admin.SetDefaultVersion):
            assert code_of(refused, policy="cartpole") == grpc.StatusCode.FAILED_PRECONDITION
        rollout = server.play_until("completed", lambda _: 10.0)
        assert rollout["percent"] == 100
        assert server.opened_version() == 2
        assert server.traffic() == {1: 0.0, 2: 1.0}
        assert "(roll-out completed)" in server.spikectl("policies")


@pytest.mark.parametrize(
    ("add", "episode_return", "reason"),
    [
        (
            add_version,
            lambda version: 500.0 if version == 1 else 9.0,
            "return is worse: mean return 9 over",
        ),
        (add_overflowing, lambda version: 500.0 if version == 1 else None, "errors is worse: "),
    ],
)
def test_a_rollout_of_a_worse_version_ends_by_itself(policies, tmp_path, add, episode_return, reason):
    add(policies, 2)
    log = tmp_path / "audit.jsonl"
    with operated(policies, f"--audit_log={log}") as server:
        server.act_on("default", "--version=1")
        server.act_on("rollout", "--version=2", "--steps=50,100", "--hold=1h")
        rollout = server.play_until("aborted", episode_return)
        assert rollout["reason"].startswith(reason)
        assert {server.play(lambda _: 1.0) for _ in range(20)} == {1}
        text = server.spikectl("admin", "rollouts")
        assert "cartpole/2: aborted at 50 % (steps 50,100)" in text
        assert "(roll-out aborted)" in server.spikectl("policies")
        metrics = server.get("/metrics")
        assert (
            'spikeserve_policy_rollout_ended_timestamp_seconds{policy="cartpole",version="2",state="aborted"}'
            in metrics
        )
        [status] = json.loads(server.get("/status.json"))["rollouts"]
        assert status["state"] == "STATE_ABORTED"
        latest = server.act_on("history")["entries"][0]
        assert latest["action"] == "AbortRollout"
        assert latest["address"] == ""
        assert latest["request"]["reason"] == rollout["reason"]
        assert latest["before"]["shares"]
        assert latest["after"]["shares"] == []


def test_a_rollout_goes_on_after_a_restart(policies, tmp_path):
    add_version(policies, 2)
    settings = f"--policy_settings={tmp_path}/settings.json"
    with operated(policies, settings) as server:
        server.act_on("default", "--version=1")
        server.act_on("rollout", "--version=2", "--steps=50,100", "--hold=1h", "--abort_if=return:5%")
        for _ in range(40):
            server.play(lambda version: float(version))
        before = server.rollout()
    with operated(policies, settings) as server:
        after = server.rollout()
        assert after["state"] == "running"
        assert after["abort_if"] == [{"measure": "return", "margin": 0.05}]
        for key in ("started", "percent"):
            assert after[key] == before[key]
        for arm in ("new_version_evidence", "stable_version_evidence"):
            for key in ("sessions", "episodes", "mean_return"):
                assert after[arm][key] == before[arm][key]
        assert server.traffic() == {1: 0.5, 2: 0.5}
        ended = server.act_on("rollout", "--abort")
        assert ended["state"] == "cancelled"
        assert ended["after"]["shares"] == []
        assert server.opened_version() == 1
    with operated(policies, settings) as server:
        assert server.rollout()["state"] == "cancelled"


def test_a_rollout_that_makes_no_sense_is_refused(policies):
    add_version(policies, 2)
    shutil.copytree(SHIPPED_POLICIES / "pendulum" / "1", policies / "cartpole" / "3")
    with operated(policies) as server:
        server.act_on("default", "--version=1")

        def refused(**fields):
            return code_of(server.admin.StartRollout, policy="cartpole", **fields)

        assert refused(version=9) == grpc.StatusCode.NOT_FOUND
        assert refused(version=1) == grpc.StatusCode.INVALID_ARGUMENT
        assert refused(version=3) == grpc.StatusCode.FAILED_PRECONDITION
        assert refused(version=2, steps=[50, 10]) == grpc.StatusCode.INVALID_ARGUMENT
        assert refused(version=2, hold_seconds=0.0) == grpc.StatusCode.INVALID_ARGUMENT
        assert code_of(server.admin.AbortRollout, policy="cartpole") == grpc.StatusCode.FAILED_PRECONDITION
        server.act_on("traffic", "--shares=1:50,2:50")
        assert refused(version=2) == grpc.StatusCode.FAILED_PRECONDITION


def test_the_history_says_who_changed_what(policies, tmp_path, certificates):
    add_version(policies, 2)
    tokens = tmp_path / "tokens.json"
    tokens.write_text(
        json.dumps({"tenants": {"ops": {}}, "tokens": [entry("secret", "operator", "ops", name="alice")]})
    )
    token = tmp_path / "token"
    token.write_text("secret")
    log = tmp_path / "audit.jsonl"
    flags = tls_flags(
        certificates, f"--audit_log={log}", f"--tokens={tokens}", f"--tls_client_ca={certificates}/ca.pem"
    )
    client_flags = (
        f"--tls_ca={certificates}/ca.pem",
        f"--tls_certificate={certificates}/client.pem",
        f"--tls_key={certificates}/client.key",
        f"--token_file={token}",
    )
    with running_server(policies, flags) as addresses:
        server = Operated(addresses, client_flags)
        server.act_on("traffic", "--shadow=1")
        with pytest.raises(AssertionError, match="NOT_FOUND"):
            server.act_on("default", "--version=9")
        refused, shadow = server.act_on("history")["entries"]
        assert shadow["action"] == "SetShadow"
        assert shadow["token"] == "alice"
        assert shadow["tenant"] == "ops"
        assert shadow["certificate"] == "CN=client"
        assert shadow["address"] == "127.0.0.1"
        assert shadow["request"]["shadow_version"] == "1"
        assert shadow["before"]["shadow_version"] == "0"
        assert shadow["after"]["shadow_version"] == "1"
        assert (refused["action"], refused["code"]) == ("SetDefaultVersion", 5)
        assert "SetShadow by alice, tenant ops, CN=client, 127.0.0.1" in server.spikectl("admin", "history")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["action"] for line in lines] == ["SetShadow", "SetDefaultVersion"]
    # Another server appends to the file and knows what is in it.
    with running_server(policies, flags) as addresses:
        server.addresses = addresses
        server.act_on("label", "--version=1", "--label=stable")
        actions = [line["action"] for line in server.act_on("history")["entries"]]
        assert actions == ["SetLabel", "SetDefaultVersion", "SetShadow"]
        assert len(server.act_on("history", "--limit=1")["entries"]) == 1
    assert len(log.read_text().splitlines()) == 3


def test_an_audit_log_that_cannot_be_written_stops_the_start(policies):
    said = refusal_at_start("--audit_log=/proc/audit.jsonl", policies=policies)
    assert "--audit_log: expected a file that the server can append to: /proc/audit.jsonl" in said


def test_health(policies):
    """spikectl health fails without a server, and while the server does not take sessions."""
    with running_server(policies) as addresses:
        assert addresses.spikectl("health").stdout == "SERVING\n"
        assert json.loads(addresses.spikectl("health", "--json").stdout) == {"health": "SERVING"}
    assert "UNAVAILABLE" in addresses.spikectl("health", status=1).stderr


def test_commands_go_to_every_server(policies, tmp_path):
    """Each with settings of its own. One lacks the file."""
    other = tmp_path / "other"
    shutil.copytree(policies, other)
    with operated(policies) as first, operated(other) as second:
        add_version(policies, 2)
        both = f"{first.addresses.grpc},{second.addresses.grpc}"

        def spikectl(*arguments):
            return run("spikectl", *arguments, f"--server={both}", status=None)

        load = ("admin", "load", "--policy=cartpole", "--version=2")
        loaded = spikectl(*load)
        assert loaded.returncode == 1
        assert f"{first.addresses.grpc}: loaded cartpole/2\n" in loaded.stdout
        assert f"{second.addresses.grpc}: failed: " in loaded.stdout
        assert f"1 of 2 servers failed: {second.addresses.grpc}: " in loaded.stderr
        add_version(other, 2)
        assert spikectl(*load).returncode == 0
        for action in (
            ("default", "--version=1"),
            ("label", "--version=2", "--label=canary"),
            ("rollout", "--version=2", "--steps=10,50"),
            ("rollout", "--abort"),
            ("unlabel", "--label=canary"),
            ("pause_learning",),
        ):
            assert spikectl("admin", action[0], "--policy=cartpole", *action[1:]).returncode == 0, action
        assert [served_versions(each) for each in (first, second)] == [[1, 2], [1, 2]]
        second.agent.OpenSession(policy="cartpole")
        rows = json.loads(spikectl("admin", "sessions", "--json").stdout)["servers"]
        assert [len(row["sessions"]) for row in rows] == [0, 1]
        assert spikectl("health").stdout == "".join(f"{each}: SERVING\n" for each in both.split(","))
        second.admin.Drain()
        healthy = spikectl("health")
        assert healthy.returncode == 1
        assert f"{first.addresses.grpc}: SERVING\n{second.addresses.grpc}: failed: " in healthy.stdout


def test_sessions_in_the_store_are_counted_before_they_are_open_again(policies, tmp_path):
    store = f"--session_store=file:{tmp_path}/store"
    with operated(policies, store) as server:
        sessions = [server.agent.OpenSession(policy="cartpole", durability="SYNC").session_id for _ in range(5)]
        for session in sessions:
            server.agent.Act(session_id=session, observation=OBSERVATION)
        server.agent.OpenSession(policy="cartpole", durability="NONE")
        assert "more in the session store" not in server.spikectl("admin", "sessions")
    with operated(policies, store) as server:
        listed = server.spikectl_json("admin", "sessions")
        assert (listed["sessions"], listed["stored_sessions"]) == ([], 5)
        assert "\n5 more in the session store; " in server.spikectl("admin", "sessions")
        server.agent.Act(session_id=sessions[0], observation=OBSERVATION, step=1)
        assert "\n4 more in the session store; " in server.spikectl("admin", "sessions")
        server.agent.CloseSession(session_id=sessions[0])
        until(lambda: server.spikectl_json("admin", "sessions")["stored_sessions"] == 4)


def test_a_run_without_a_version_reaches_the_canary(policies):
    add_version(policies, 2)
    with operated(policies) as server:
        server.act_on("default", "--version=1")
        server.act_on("traffic", "--shares=1:50,2:50")

        def played(*more):
            play = ("run", "--env=CartPole-v1", "--policy=cartpole", "--quiet")
            return server.spikectl(*play, *more).split("with policy ")[1].split()[0]

        routes = set()

        def both_are_reached():
            routes.add(played())
            return routes == {"cartpole/1", "cartpole/2"}

        until(both_are_reached)
        assert [played(f"--version={version}") for version in (1, 2)] == ["cartpole/1", "cartpole/2"]


def test_names_of_earlier_releases_are_understood_with_a_hint(policies):
    with operated(policies) as server:

        def spikectl(action):
            return server.addresses.spikectl("admin", action, "--policy=cartpole")

        for old, new in (("rollback", "reset_head"), ("pause", "pause_learning"), ("resume", "resume_learning")):
            was, now = spikectl(old), spikectl(new)
            assert (was.stdout, now.stderr) == (now.stdout, "")
            assert was.stderr.startswith(f"spikectl: admin {old} is called admin {new} now")
        assert "admin default --version=N" in spikectl("rollback").stderr
        shown = run("spikectl", "admin", "--help").stdout
        assert "reset_head" in shown and "rollback" not in shown


def test_a_rollout_shows_its_conditions_and_no_figures_of_nothing(policies):
    add_version(policies, 2)
    with operated(policies) as server:
        server.act_on("default", "--version=1")
        started = server.act_on("rollout", "--version=2", "--hold=60")
        assert started["hold_seconds"] == 60
        assert [each["measure"] for each in started["abort_if"]] == ["return", "errors", "p99"]
        assert started["new_version_evidence"]["mean_return"] is None
        assert started["new_version_evidence"]["p99_seconds"] is None
        text = server.spikectl("admin", "rollouts")
        assert "ends if worse by: return:0%,errors:1%,p99:25%" in text
        assert text.count("no sessions yet") == 2 and "p99 0" not in text
        [entry, _] = server.act_on("history")["entries"]
        assert len(entry["request"]["abort_if"]) == 3
        assert entry["request"]["steps"] == [1, 10, 50, 100]
