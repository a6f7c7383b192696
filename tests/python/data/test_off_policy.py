"""`spiketrain ope` estimates a version's return from another one's recordings, and a roll-out asks for its report."""

import json
import shutil

import cbor2
import gymnasium
import numpy as np
import pytest
import spikeserve
from policy_file import read_policy, write_policy
from spikeserve.evaluation import play_episode
from serving import SHIPPED_POLICIES, run, running_server, status_of

EPISODES, STEPS = 60, 40


def changed_head(source, destination, size):
    """Copies a version with a head that differs by `size` of its deviation."""
    tensors, metadata = read_policy(source / "policy.safetensors")
    head = tensors["head.weight"]
    noise = np.random.default_rng(7).standard_normal(head.shape)
    tensors["head.weight"] = (head + size * head.std() * noise).astype("f4")
    write_policy(destination / "policy.safetensors", tensors, metadata)


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    for name in ("cartpole", "pendulum"):
        shutil.copytree(SHIPPED_POLICIES / name / "1", folder / name / "1")
    for version, size in ((2, 0.02), (3, 3.0)):
        changed_head(folder / "cartpole/1", folder / f"cartpole/{version}", size)
    return folder


@pytest.fixture(scope="module")
def recordings(policies, tmp_path_factory):
    """Returns a folder with a folder of recordings each for sampled, greedy and Box actions, and sessions with one seed."""
    top = tmp_path_factory.mktemp("recordings")
    kinds = {
        "sampled": ("cartpole", "CartPole-v1", EPISODES, {"sample": True}),
        "greedy": ("cartpole", "CartPole-v1", 1, {}),
        "box": ("pendulum", "Pendulum-v1", EPISODES, {"sample": True, "temperature": 0.5}),
        "one_seed": ("cartpole", "CartPole-v1", EPISODES, {"sample": True, "seed": 7}),
    }
    for kind, (policy, environment, episodes, options) in kinds.items():
        with (
            running_server(policies, [f"--record_dir={top / kind}"]) as server,
            spikeserve.Client(server.grpc) as client,
            gymnasium.make(environment, max_episode_steps=STEPS) as task,
        ):
            for seed in range(episodes):
                chosen = spikeserve.SessionOptions(**{"seed": seed, "version": 1, "record": True} | options)
                with client.open_session(policy, chosen) as session:
                    play_episode(task, session, seed)
    return top


# Who chose the actions of some steps, which are those of CartPole.
OTHERS = {3: ("operator", 0), 4: ("held", 1), 5: ("safe", 0), 6: ("safety_layer", 1), 7: ("local", 1)}


@pytest.fixture(scope="module")
def shared_control(policies, tmp_path_factory):
    """Returns a folder with recordings of sessions in which others chose some actions."""
    folder = tmp_path_factory.mktemp("shared_control")
    with (
        running_server(policies, [f"--record_dir={folder}"]) as server,
        spikeserve.Client(server.grpc) as client,
        gymnasium.make("CartPole-v1", max_episode_steps=STEPS) as task,
    ):
        for seed in range(EPISODES):
            options = spikeserve.SessionOptions(seed=seed, version=1, record=True, sample=True)
            with client.open_session("cartpole", options) as session:
                observation, _ = task.reset(seed=seed)
                reward, executed, is_over = None, None, False
                for step in range(STEPS):
                    action = session.act(observation, reward, executed_action=executed).action
                    source, chosen = OTHERS.get(step, (None, action))
                    executed = source and spikeserve.Executed(chosen, source)
                    observation, reward, terminated, truncated, _ = task.step(chosen)
                    is_over = terminated or truncated
                    if is_over:
                        break
                session.end_episode(reward, terminated=terminated, truncated=truncated)
    return folder


def test_steps_that_others_chose_are_not_weighed(policies, shared_control):
    """A filter changes what the policy has answered; what others choose, the new version would have met, too."""
    temperature = 1.2
    logs = []
    others = dict.fromkeys((source for source, _ in OTHERS.values()), 0)
    for path in shared_control.rglob("*.cbor"):
        episode = cbor2.loads(path.read_bytes())["episodes"][0]
        served = episode["served"]
        recorded = np.array(served["probabilities"], float).reshape(-1, 2)
        evaluated = recorded ** (1 / temperature)
        evaluated /= evaluated.sum(axis=1, keepdims=True)
        total = 0.0
        for step, answered in enumerate(served.get("answered_actions", episode["actions"])):
            source, chosen = OTHERS.get(step, ("policy", answered))
            assert "sources" not in served or served["sources"][step] == source
            if source != "policy":
                others[source] += 1
            if source == "policy" or (source == "safety_layer" and chosen != answered):
                total += np.log(evaluated[step, answered] / recorded[step, answered])
        logs.append(total)
    report = report_of(shared_control, policies / "cartpole/1", f"--temperature={temperature}")
    weights = np.exp(logs)
    assert report["effective_episodes"] == pytest.approx(weights.sum() ** 2 / (weights**2).sum(), rel=1e-5)
    assert report["other_steps"] == others
    text = ope(shared_control, policies / "cartpole/1").stdout
    assert f"others have chosen: operator {others['operator']}" in text
    same = report_of(shared_control, policies / "cartpole/1")
    assert same["difference"] == pytest.approx(0, abs=1e-4 * same["recorded_return"])


def ope(recordings, policy, *flags, **options):
    return run("spiketrain", "ope", f"--recordings={recordings}", f"--policy={policy}/policy.safetensors", *flags, **options)


def report_of(recordings, policy, *flags):
    return json.loads(ope(recordings, policy, "--json", *flags).stdout)


@pytest.mark.parametrize(("kind", "policy"), [("sampled", "cartpole"), ("box", "pendulum")])
def test_the_version_that_played_has_the_return_that_it_had(kind, policy, policies, recordings):
    report = report_of(recordings / kind, policies / policy / "1")
    assert report["new_sha256"] == report["recorded_sha256"] != ""
    assert report["episodes"] == report["units"] == EPISODES
    assert report["effective_episodes"] == pytest.approx(EPISODES, rel=1e-6)
    assert report["importance_sampling"]["new_return"][0] == pytest.approx(report["recorded_return"], rel=1e-6)
    assert report["difference"] == pytest.approx(0, abs=1e-4 * abs(report["recorded_return"]))
    assert report["verdict"] == "no clear difference"
    rewards = [
        sum(cbor2.loads(path.read_bytes())["episodes"][0]["rewards"]) for path in (recordings / kind).rglob("*.cbor")
    ]
    assert report["recorded_return"] == pytest.approx(np.mean(rewards))


def test_another_temperature_weighs_the_noise_of_a_box(policies, recordings):
    """The probability of every noise is that of the normal distribution."""
    report = report_of(recordings / "box", policies / "pendulum/1", "--temperature=0.51")
    logs = []
    for path in (recordings / "box").rglob("*.cbor"):
        noise = np.array(cbor2.loads(path.read_bytes())["episodes"][0]["served"]["noise"])
        assert len(noise) == STEPS
        logs.append(np.sum(noise**2 * (1 - (0.5 / 0.51) ** 2) / 2 - np.log(0.51 / 0.5)))
    weights = np.exp(logs)
    assert report["effective_episodes"] == pytest.approx(weights.sum() ** 2 / (weights**2).sum(), rel=1e-5)


def test_what_cannot_be_told_is_said(policies, recordings):
    text = ope(recordings / "sampled", policies / "cartpole/3").stdout
    assert "verdict: cannot tell" in text
    assert "up to 0.01" in text  # the overlap
    report = report_of(recordings / "one_seed", policies / "cartpole/2")
    assert (report["units"], report["can_tell"]) == (1, False)
    error = ope(recordings / "greedy", policies / "cartpole/2", status=1).stderr
    assert "drawn at random" in error and "action_selection SAMPLE" in error
    error = ope(recordings / "sampled", policies / "pendulum/1", status=1).stderr
    assert error.startswith("spiketrain: --recordings: ")


def test_a_rollout_asks_for_a_report_of_its_files(policies, recordings, tmp_path):
    reports = {}
    for version in (1, 2, 3):
        reports[version] = tmp_path / f"{version}.json"
        reports[version].write_text(ope(recordings / "sampled", policies / f"cartpole/{version}", "--json").stdout)
    report = json.loads(reports[2].read_text())
    assert report["can_tell"]
    settings = tmp_path / "settings.json"
    with running_server(policies, [f"--policy_settings={settings}"]) as server:
        server.admin.SetDefaultVersion(policy="cartpole", version=1)

        def start(name, version=2, **options):
            flags = ("--policy=cartpole", f"--version={version}", f"--require_ope={name}")
            return server.spikectl("admin", "rollout", *flags, **options)

        assert "new_sha256" in start(reports[1], status=1).stderr
        assert "cannot tell" in start(reports[3], version=3, status=1).stderr
        worse = tmp_path / "worse.json"
        worse.write_text(json.dumps(report | {"difference_high": -1.0}))
        assert "the new version is worse" in start(worse, status=1).stderr
        worse.write_text("no report")
        assert "--require_ope" in start(worse, status=1).stderr
        assert not server.admin.ListRollouts().rollouts
        assert f"expected before: return {report['new_return']:.4g}" in start(reports[2]).stdout
        (rollout,) = status_of(server)["rollouts"]
        assert rollout["offline_evaluation"]["difference_low"] == pytest.approx(report["difference_low"])
    with running_server(policies, [f"--policy_settings={settings}"]) as server:
        (rollout,) = server.admin.ListRollouts().rollouts
        assert rollout.offline_evaluation.new_sha256 == report["new_sha256"]
