"""`spikectl` with a real server: lists, plays, explains, adapts and administers, and says in one line what is wrong."""

import json
import shutil

import pytest
from policy_file import read_policy, write_policy
from security import OBSERVATION
from serving import SHIPPED_POLICIES, add_version, metric, running_server

ENVIRONMENTS = {
    "CartPole-v1": "cartpole-small/1",
    "MountainCar-v0": "mountaincar/1",
    "Acrobot-v1": "acrobot/1",
    "Pendulum-v1": "pendulum/1",
}
ADAPT = ("adapt", "--env=CartPole-v1", "--episodes=3", "--seed=5")


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """Makes a folder with a policy for each environment, whose name is that of the task in lower case.

    That for CartPole has a head of zeros, which lets the pole fall, so that its episodes are short.
    """
    folder = tmp_path_factory.mktemp("policies") / "policies"
    for environment, version in ENVIRONMENTS.items():
        add_version(folder, environment.lower(), 1, SHIPPED_POLICIES / version)
    tensors, metadata = read_policy(folder / "cartpole-v1/1/policy.safetensors")
    tensors["head.weight"][:] = tensors["head.bias"][:] = 0
    metadata["training"] = json.dumps(json.loads(metadata["training"]) | {"rounding_loss": {"share": 0.031}})
    shutil.rmtree(folder / "cartpole-v1/1")
    write_policy(folder / "cartpole-v1/1/policy.safetensors", tensors, metadata)
    return folder


@pytest.fixture(scope="module")
def server(policies):
    """Starts a server that tests use which change nothing of it."""
    with running_server(policies) as started:
        yield started


@pytest.fixture
def own_server(policies, tmp_path):
    """Starts a server of its own for a test that changes it. Its policies are those of tmp_path / "policies"."""
    shutil.copytree(policies, tmp_path / "policies")
    with running_server(tmp_path / "policies") as started:
        yield started


def result(server, *arguments):
    """Returns the JSON object that a command prints."""
    finished = server.spikectl(*arguments, "--json")
    assert finished.stderr == ""
    return json.loads(finished.stdout)


def assert_one_line(server, message, *arguments):
    """Asserts that a command fails with one line that has the message in it."""
    finished = server.spikectl(*arguments, status=1)
    assert finished.stdout == ""
    assert message in finished.stderr
    assert finished.stderr.count("\n") == 1, finished.stderr


def test_it_lists_the_policies(server):
    listed = result(server, "policies")["policies"]
    assert [policy["name"] for policy in listed] == sorted(map(str.lower, ENVIRONMENTS))
    cart_pole = listed[1]
    assert cart_pole["action_space"]["n"] == 2
    expected = {"version": 1, "is_default": True, "environment": "CartPole-v1", "observation_size": 4, "target_return": 500}
    assert {key: cart_pole[key] for key in expected} == expected
    assert [policy.get("rounding_loss") for policy in listed] == [None, 0.031, None, None]
    head, *rows = (line.split() for line in server.spikectl("policies").stdout.splitlines())
    assert head == ["POLICY", "ENVIRONMENT", "MODE", "INPUTS", "ACTION", "RETURN", "LOST", "TRAFFIC"]
    assert [(row[0], row[6]) for row in rows[:2]] == [("acrobot-v1/1", "-"), ("cartpole-v1/1", "3.1%")]
    assert rows[3][0] == "pendulum-v1/1"


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_it_plays_and_agrees_with_the_metrics(server, environment):
    def count(name):
        return metric(server, f"spikeserve_{name}_total", policy=environment.lower())

    server.spikectl("run", f"--env={environment}", "--episodes=1", "--quiet")  # makes the series
    before = [count(name) for name in ("decisions", "spikes")]
    run = result(server, "run", f"--env={environment}", "--episodes=3", "--seed=11")
    decisions, spikes = (count(name) - old for name, old in zip(("decisions", "spikes"), before, strict=True))
    assert set(run) == {
        *("episodes", "mean_return", "spikes_per_decision", "energy_joules_per_decision", "energy_model"),
        *("energy_models", "p50_seconds", "p99_seconds"),
    }
    episodes = run["episodes"]
    assert len(episodes) == 3
    assert all(set(episode) == {"return", "steps", "spikes_per_decision"} for episode in episodes)
    assert sum(episode["steps"] for episode in episodes) == decisions
    assert sum(round(episode["steps"] * episode["spikes_per_decision"]) for episode in episodes) == spikes
    assert run["mean_return"] == pytest.approx(sum(episode["return"] for episode in episodes) / 3)
    assert run["spikes_per_decision"] == pytest.approx(spikes / decisions)
    models = run["energy_models"]
    assert set(models) == {"horowitz_45nm", "int_45nm", "int_sram_45nm", "spike_5pj"}
    assert run["energy_joules_per_decision"] == models[run["energy_model"]]["joules_per_decision"]
    assert models["spike_5pj"]["joules_per_decision"] == pytest.approx(5e-12 * spikes / decisions)
    assert 0 < run["p50_seconds"] <= run["p99_seconds"]
    assert metric(server, "spikeserve_sessions") == 0


def test_episode_i_sees_the_start_of_seed_plus_i(server):
    def returns(episodes, seed):
        run = result(server, "run", "--env=Pendulum-v1", f"--episodes={episodes}", f"--seed={seed}")
        return [episode["return"] for episode in run["episodes"]]

    first, second, third = returns(3, 100)
    assert first != second
    assert returns(2, 101) == [second, third]


def test_it_prints_a_line_or_a_dot_for_every_episode_and_a_summary(server):
    play = ("run", "--env=CartPole-v1", "--seed=1000000")
    run = server.spikectl(*play, "--episodes=2")
    assert run.stderr == ""
    for part in ("CartPole-v1 with policy cartpole-v1/1 (baseline)", " 1000000 ", " 1000001 ", "mean return"):
        assert part in run.stdout
    assert " nJ a decision by the estimate int_sram_45nm" in run.stdout
    quiet = server.spikectl(*play, "--episodes=3", "--quiet").stdout
    assert quiet.startswith("CartPole-v1 with policy cartpole-v1/1 (baseline) ...\nmean return ")
    assert "1000001" not in quiet
    server.spikectl("run", "--env=Acrobot-v1", "--policy=acrobot-v1", "--version=1", "--target_return=-80")


def test_it_explains_a_decision_of_a_session_it_plays(server):
    explain = ("explain", "--env=Acrobot-v1", "--steps=6", "--seed=3")
    explained = result(server, *explain)
    assert explained["answer"]["step"] == "5"  # JSON's form of an int64 in proto3
    assert all(len(raster["ticks"]) == len(raster["neurons"]) for raster in explained["rasters"])
    spikes = sum(len(raster["ticks"]) for raster in explained["rasters"])
    assert explained["answer"]["stats"]["spikes"] == str(spikes)
    text = server.spikectl(*explain).stdout
    for part in (
        "acrobot-v1/1 (full), session ",
        "layer 0 coder of s_5: ",
        "layer 1 gates of s_5, mean over ticks: ",
        "layer 1 head 1 attends most to: ",
    ):
        assert part in text
    assert metric(server, "spikeserve_sessions") == 0


def test_it_explains_a_session_of_somebody_else(server):
    session = server.agent.OpenSession(policy="cartpole-v1").session_id
    assert_one_line(server, "expected a session that has decided", "explain", f"--session={session}")
    server.agent.Act(session_id=session, observation=OBSERVATION)
    assert result(server, "explain", f"--session={session}")["session_id"] == session
    server.agent.CloseSession(session_id=session)  # it was left open
    assert_one_line(server, "nobody", "explain", "--session=nobody")


ADAPTING = "--perturb=force=-1"


def test_one_session_learns(own_server):
    adapted = result(own_server, *ADAPT, ADAPTING)
    assert set(adapted) == {
        *("unperturbed_return", "frozen_return", "adapted_return", "episodes", "curve", "head_drift", "rollbacks")
    }
    assert adapted["episodes"] == len(adapted["curve"]) == 3
    assert adapted["head_drift"] > 0
    assert adapted["adapted_return"] != adapted["frozen_return"]
    assert metric(own_server, "spikeserve_learning_updates_total") == 3
    assert metric(own_server, "spikeserve_sessions") == 0
    assert result(own_server, *ADAPT, ADAPTING) == adapted  # it depends only on the seed


def test_a_fleet_learns_and_its_head_becomes_a_version_of_its_own(own_server):
    policy = "--policy=cartpole-v1"
    assert_one_line(own_server, "FAILED_PRECONDITION", "admin", "promote_head", policy)
    adapted = result(own_server, *ADAPT, "--perturb=wind=4", "--scope=fleet", "--fleet=4")
    assert len(adapted["curve"]) == 3
    assert adapted["head_drift"] > 0
    assert metric(own_server, "spikeserve_learning_updates_total") == 12
    head = result(own_server, "admin", "head", policy, "--weights")
    assert (head["version"], head["paused"]) == (1, False)
    assert head["updates"] > 0 and head["drift"] > 0
    assert len(head["delta"]) == len(head["base"]) > 0
    assert "base" not in result(own_server, "admin", "head", policy)
    promoted = result(own_server, "admin", "promote_head", policy)
    assert promoted["version"] == 2
    served = result(own_server, "policies")["policies"]
    assert ("cartpole-v1", 2) in [(policy["name"], policy["version"]) for policy in served]
    assert result(own_server, "admin", "reset_head", policy, "--version=1")["drift"] == head["drift"]
    assert result(own_server, "admin", "head", policy, "--version=1")["drift"] == 0


def test_the_task_may_stay_as_it_is_and_the_curve_is_printed(server):
    unperturbed = result(server, *ADAPT)
    assert unperturbed["frozen_return"] == unperturbed["unperturbed_return"]
    text = server.spikectl(*ADAPT, "--perturb=length=2").stdout
    for part in ("CartPole-v1 with length=2, policy cartpole-v1/1, 1 learning", " |####", "greedy, mean of 50 unseen starts: "):
        assert part in text


def test_an_operator_lists_drains_and_pauses(own_server):
    session = own_server.agent.OpenSession(policy="pendulum-v1").session_id
    [listed] = result(own_server, "admin", "sessions")["sessions"]
    assert listed["session_id"] == session
    assert session in own_server.spikectl("admin", "sessions").stdout
    assert result(own_server, "admin", "drain")["open_sessions"] == 1
    own_server.spikectl("health", status=1)
    assert result(own_server, "admin", "drain", "--cancel")["draining"] is False

    def paused(policy):
        return result(own_server, "admin", "head", f"--policy={policy}")["paused"]

    assert result(own_server, "admin", "pause_learning", "--policy=cartpole-v1")["paused"] is True
    assert "learning is paused" in own_server.spikectl("admin", "head", "--policy=cartpole-v1").stdout
    assert not paused("pendulum-v1")
    own_server.spikectl("admin", "pause_learning")
    assert paused("pendulum-v1")
    assert "every policy: learning resumed" in own_server.spikectl("admin", "resume_learning").stdout
    assert not paused("cartpole-v1")


def test_a_version_from_load_to_unload(own_server, tmp_path):
    add_version(tmp_path / "policies", "pendulum-v1", 2, SHIPPED_POLICIES / "pendulum/1")

    def admin(action, *flags):
        return result(own_server, "admin", action, "--policy=pendulum-v1", *flags)

    assert admin("load", "--version=2")["is_default"] is False
    assert [admin("default", f"--version={version}")["version"] for version in (2, 1)] == [2, 1]
    assert admin("label", "--version=2", "--label=canary")["label"] == "canary"
    assert admin("traffic", "--shares=1:90,2:10", "--shadow=2")["shares"][1]["percent"] == 10
    listed = result(own_server, "policies")["policies"][-1]
    assert (listed["version_labels"], listed["traffic_percent"], listed["is_shadow"]) == (["canary"], 10, True)
    assert_one_line(own_server, "FAILED_PRECONDITION", "admin", "unload", "--policy=pendulum-v1", "--version=2")
    admin("traffic", "--shares=none", "--shadow=0")
    admin("unlabel", "--label=canary")
    admin("unload", "--version=2")
    assert result(own_server, "admin", "reload")["loaded"] == []


COMMANDS = (
    "policies, health, run, explain, adapt, replay, usage, push, pull, rm, admin, hold, resume, holds, take, store, emit-c, policy, doctor"
)
PENDULUM = "--policy=pendulum-v1"
MISTAKES = [
    (["fly"], f'command: expected one of {COMMANDS}, received "fly"'),
    (["run", "land"], 'expected flags alone, received "land"'),
    (["run", "--env=Pong-v0"], '"Pong-v0"'),
    (["run", "--episodes=0"], "--episodes: expected at least 1, received 0"),
    (["run", "--episodes=many"], '--episodes: expected an integer, received "many"'),
    (["run", "--seed=-1"], '--seed: expected an integer of at least 0, received "-1"'),
    (["run", "--version=-1"], "--version: expected at least 0, received -1"),
    (["run", "--target_return=inf"], "--target_return"),
    (["run", "--altitude=3"], "--altitude: expected a flag of spikectl run"),
    (["run", "--policy=nobody"], 'no policy "nobody" is served'),
    (["run", "--version=9"], "version 9"),
    (["run", PENDULUM], "observations of length 3"),
    (["run", "--fleet=3"], "--fleet: expected a flag of spikectl run (see spikectl run --help)"),
    (["policies", "--seed=1"], "--seed: expected a flag of spikectl policies"),
    (["explain", "--session=x", "--steps=3"], "--steps: expected no such flag beside --session, received 3"),
    (["explain", "--steps=0"], "--steps: expected at least 1, received 0"),
    ([*ADAPT, "--perturb=force"], "--perturb: expected NAME=VALUE"),
    ([*ADAPT, "--perturb=glue=1"], "--perturb: expected one of wind, length"),
    ([*ADAPT, "--scope=town"], '--scope: expected session or fleet, received "town"'),
    ([*ADAPT, "--scope=fleet", "--fleet=0"], "--fleet: expected 1 to 1000, received 0"),
    ([*ADAPT, "--rule=habit"], '--rule: expected policy_gradient, hebbian, hebbian_action or corrections, received "habit"'),
    ([*ADAPT, "--learning_rate=-1"], "--learning_rate: expected"),
    (["adapt", "--env=Pong-v0"], "--env: environment: expected one of CartPole-v1"),
    (["adapt", "--env=PositionOnlyCartPole-v1", "--perturb=glue=1"], "--perturb: expected one of wind, length"),
    (["adapt", "--env=CartPole-v1", "--episodes=0"], "--episodes: expected at least 1, received 0"),
    (["admin", "fly"], "expected one of load, unload"),
    (["admin", "reload", "--policy=x"], "--policy: expected a flag of spikectl admin reload"),
    (["admin", "load", "--policy=x", "--label=y"], "--label: expected a flag of spikectl admin load"),
    (["admin", "load"], "--policy: expected a name"),
    (["admin", "load", PENDULUM, "--version=9"], "NOT_FOUND"),
    (["admin", "promote_head"], "--policy: expected a name"),
    (["admin", "pause_learning", "--policy=nobody"], "NOT_FOUND"),
    (["admin", "traffic", PENDULUM], "--shares: expected shares, none"),
    (["admin", "traffic", PENDULUM, "--shares=1"], "--shares: expected VERSION:PERCENT"),
    (["admin", "rollout", PENDULUM, "--steps=few"], '--steps: expected percentages such as 1,10,50,100, received "few"'),
    (["admin", "rollout", PENDULUM, "--abort_if=returns"], "--abort_if: expected return, errors or p99"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES, ids=[" ".join(arguments) for arguments, _ in MISTAKES])
def test_it_says_in_one_line_what_is_wrong(server, arguments, message):
    assert_one_line(server, message, *arguments)


def test_without_a_policy_for_the_environment_it_says_what_there_is(tmp_path):
    add_version(tmp_path, "cartpole-v1")
    with running_server(tmp_path) as server:
        expected = "no policy for Acrobot-v1 is served; the server has cartpole-v1/1"
        assert_one_line(server, expected, "run", "--env=Acrobot-v1")
