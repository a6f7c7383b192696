"""Tasks whose observation lacks velocities: what a line on two observations learns, the policy learns.

In a small form; test_imitate.py has the long one.
"""

import json
import os
import re
import subprocess
import sys

import gymnasium
import hidden_state
import numpy as np
import pytest
import spikeserve
import spikeserve_engine
from gymnasium import spaces
from serving import run, running_server
from spikeserve.flat_spaces import ObservationMap
from spikeserve.imitation.actors import Bursts, ExpertActor
from spikeserve.imitation.baselines import BaselineActor, Comparison
from spikeserve.imitation.datasets import read_dataset, write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play
from spikeserve.imitation.experts import load_expert
from spikeserve.imitation.figures import Evaluator
from spikeserve.imitation.options import ImitationOptions
from stored_sessions import Restartable

SPIKETRAIN = os.environ["SPIKETRAIN"]
EXPERTS = {
    "Reacher2D-v0": hidden_state.reach,
    "Spring-v0": hidden_state.hold,
    "Vehicle-v0": hidden_state.brake,
    "Thermostat-v0": hidden_state.heat,
    "AnglePendulum-v0": hidden_state.swing_up,
}


@pytest.mark.parametrize("name", EXPERTS)
def test_an_expert_that_knows_the_state_is_far_from_chance(name):
    evaluator = Evaluator(EnvironmentFactory(f"hidden_state:{name}"), 10)
    expert = evaluator.evaluate(ExpertActor(load_expert(EXPERTS[name])), 0, 20, name)
    assert expert.mean > 0.3 * evaluator.evaluate_chance(0, 20).mean


def record(folder, name, episodes):
    factory = EnvironmentFactory(f"hidden_state:{name}")
    actor = ExpertActor(load_expert(EXPERTS[name]), Bursts(0, 0.8, 0.3, 8))
    write_dataset(folder, list(play(factory.make, actor, iter(range(episodes)), 10)), factory.make(), name)
    return factory


def spiketrain(*arguments):
    finished = run(SPIKETRAIN, *map(str, arguments))
    return finished.stdout


TINY = "--mode=baseline --hidden_size=32 --layers=1 --ticks=6 --context=3 --clip_steps=3 --batch=64".split()


def test_the_data_decide_whether_changes_are_observed(tmp_path):
    record(tmp_path / "spring-v0", "Spring-v0", 40)
    flags = [f"--data={tmp_path}/spring-v0", *TINY, "--iterations=1", "--no_baselines"]
    assert ", observation changes\n" in spiketrain("train", f"--out={tmp_path}/auto", *flags)
    off = spiketrain("train", f"--out={tmp_path}/off", "--observation_changes=false", *flags)
    assert "observation changes" not in off


def test_no_changes_where_one_observation_is_the_state(tmp_path):
    out = spiketrain("train", "--env=CartPole-v1", "--steps=3000", f"--out={tmp_path}", *TINY, "--iterations=1")
    assert "observation changes" not in out


@pytest.mark.parametrize("mode", ["dense", "baseline"])
def test_the_policy_learns_what_a_line_on_two_observations_learns(tmp_path, mode):
    """Without the changes the same training stays at the error of a line on one observation, and a warning says so."""
    record(tmp_path / "spring-v0", "Spring-v0", 60)
    errors = {}
    for changes in ("true", "false"):
        out = tmp_path / changes
        flags = [*TINY, f"--mode={mode}", "--iterations=250", "--learning_rate=0.004", "--action_noise=0.5", "--slope=4"]
        text = spiketrain(
            "train", f"--data={tmp_path}/spring-v0", f"--out={out}", *flags, f"--observation_changes={changes}"
        )
        comparison = Comparison.read(out / "baselines.json")
        errors[changes] = comparison.policy_error
        line = {baseline.name: baseline.error for baseline in comparison.baselines}
        if changes == "false":
            assert "warning: line on 2 frames imitates better than the policy: error" in text
    assert line["line on 2 frames"] < 0.2 * line["line on 1 frame"]
    assert errors["true"] < 0.5 * line["line on 1 frame"]
    assert errors["true"] < 0.6 * errors["false"]


def test_baselines_are_played_as_they_were_fitted(tmp_path):
    factory = record(tmp_path / "spring-v0", "Spring-v0", 40)
    spiketrain("train", f"--data={tmp_path}/spring-v0", f"--out={tmp_path}/policy", *TINY, "--iterations=1")
    comparison = Comparison.read(tmp_path / "policy/baselines.json")
    names = [f"{kind} on {frames}" for kind in ("line", "mlp") for frames in ("1 frame", "2 frames", "4 frames")]
    assert [baseline.name for baseline in comparison.baselines] == names
    held_out = list(read_dataset(tmp_path / "spring-v0"))[-4:]
    for baseline in comparison.baselines:
        errors = [
            (np.clip(baseline.outputs(episode.observations[: step + 1]), -1, 1) - label) ** 2
            for episode in held_out
            for step, label in enumerate(episode.labels)
        ]
        assert np.mean(errors) == pytest.approx(baseline.error, rel=1e-3)
    evaluator = Evaluator(factory, 10)
    returns = {b.name: evaluator.evaluate(BaselineActor(b), 1_000_000, 10, b.name).mean for b in comparison.baselines}
    assert returns["line on 2 frames"] > 0.2 * returns["line on 1 frame"]


def test_a_server_decides_like_the_engine_with_changes(tmp_path):
    """Two episodes: the first observation of each has no change."""
    record(tmp_path / "spring-v0", "Spring-v0", 10)
    for mode in ("dense", "full"):
        out = tmp_path / "policies" / mode / "1"
        flags = [*TINY, f"--mode={mode}", "--context=1", "--clip_steps=1", "--iterations=2", "--no_baselines"]
        spiketrain("train", f"--data={tmp_path}/spring-v0", f"--out={out}", *flags, "--observation_changes=true")
    spiketrain(
        "quantize", f"--policy={tmp_path}/policies/full/1/policy.safetensors",
        f"--out={tmp_path}/policies/full/2/policy.safetensors", f"--data={tmp_path}/spring-v0", "--allow_loss",
    )  # fmt: skip
    with running_server(tmp_path / "policies") as addresses, spikeserve.Client(addresses.grpc) as client:
        for name, version in (("dense", 1), ("full", 1), ("full", 2)):
            engine = spikeserve_engine.Engine(tmp_path / f"policies/{name}/{version}/policy.safetensors")
            mine = engine.session()
            with client.open_session(name, spikeserve.SessionOptions(version=version)) as theirs:
                random = np.random.default_rng(0)
                for _ in range(2):
                    for _ in range(5):
                        seen = random.normal(size=2).astype(np.float32)
                        np.testing.assert_array_equal(mine.act(seen, 0.1).action, theirs.act(seen, 0.1).action)
                    mine.end_episode(0.0, True, False)
                    theirs.end_episode(0.0, terminated=True)


def test_a_killed_server_knows_the_last_observation(tmp_path):
    """The change since the last observation survives a crash, although the context is one step."""
    record(tmp_path / "spring-v0", "Spring-v0", 4)
    policy = tmp_path / "policies/spring/1"
    flags = [*TINY, "--context=1", "--clip_steps=1", "--iterations=2", "--no_baselines", "--observation_changes=true"]
    spiketrain("train", f"--data={tmp_path}/spring-v0", f"--out={policy}", *flags)
    mine = spikeserve_engine.Engine(policy / "policy.safetensors").session()
    with Restartable(f"file:{tmp_path}/store", policies=tmp_path / "policies") as server:
        session = server.OpenSession(policy="spring", durability="SYNC").session_id
        for step in range(6):
            seen = [0.3 * step * step, 1.0]
            theirs = server.Act(session_id=session, step=step, observation=seen, reward=0.1)
            expected = mine.act(np.array(seen, np.float32), 0.1).action
            np.testing.assert_array_equal(np.array(theirs.action.continuous.values, np.float32), expected)
            server.restart()


SMALLEST = ImitationOptions(
    environments=3,
    steps=900,
    hidden_size=16,
    batch=4,
    iterations=4,
    seeds=2,
    rounds=1,
    round_steps=300,
    round_iterations=2,
    silence=(),
    selection_episodes=3,
    episodes=4,
    context=2,
    clip_steps=2,
    train_flags=("--heads=2", "--validate_every=2"),
)


def test_a_dense_policy_is_imitated_to_the_end_and_the_report_tells_why(tmp_path):
    options = ImitationOptions(**(vars(SMALLEST) | {"mode": "dense"}))
    arguments = ("hidden_state:Spring-v0", hidden_state.hold, tmp_path / "run")
    result = spikeserve.imitate(*arguments, options=options, spiketrain=SPIKETRAIN)
    assert result.quantized is None and result.quantized_figures is None
    assert len(result.baselines) == 6
    assert re.fullmatch(
        r"-?\d+% of the way from random actions to the expert; it explains -?\d+% of the actions of held-out steps"
        r"(; undertrained: the validation loss of the first trainings still fell)?",
        result.verdict.reason,
    )
    assert not result.verdict.meets("good") and result.verdict.meets("bad") and result.advice
    assert any("line on 2 frames returns more than the policy" in warning for warning in result.warnings)
    report = result.report.read_text()
    for text in (
        f"**Verdict: {result.verdict.grade}**: ",
        "Random actions return -",
        "All returns of this table are those of the first 4 of the starts above.",
        "| line on 2 frames |",
        "**Warning:** ",
        "## What to try next",
        "sets a floor of 0.0000 to the error",
        "In closed loop, against what the expert would do",
        "Validation loss of the first trainings, mean and deviation over their seeds:",
    ):
        assert text in report
    metadata = json.loads((tmp_path / "run/metadata.json").read_text())
    assert len(metadata["drift"]) == 10
    assert metadata["share_of_the_way_to_the_expert"] < 1
    with pytest.raises(ValueError, match="another folder, or --overwrite, received other steps"):
        other = ImitationOptions(**(vars(options) | {"steps": 600}))
        spikeserve.imitate(*arguments, options=other, spiketrain=SPIKETRAIN)
    policy = result.policy.read_bytes()
    spikeserve.imitate(*arguments, options=other, spiketrain=SPIKETRAIN, overwrite=True)
    assert result.policy.read_bytes() != policy


def test_policies_of_something_else_are_not_overwritten(tmp_path):
    (tmp_path / "policies").mkdir()
    with pytest.raises(ValueError, match="out: expected a new folder, or one of an earlier run, received .*policies"):
        spikeserve.imitate("CartPole-v1", lambda observation: 0, tmp_path, spiketrain=SPIKETRAIN)


def test_parts_of_a_space_that_are_not_numbers_are_named():
    mission = spaces.Dict({"image": spaces.Box(0, 9, (7, 7, 3), np.uint8), "mission": spaces.Text(9)})
    with pytest.raises(ValueError, match=r"observation_space\['mission'\]: expected Box, .* received Text"):
        ObservationMap(mission)
    with pytest.raises(ValueError, match=r"observation_space: expected Box, .* received Text"):
        ObservationMap(spaces.Text(9))
    with pytest.raises(ValueError, match=r"observation_space\[1\]\['a'\]: expected Box, .* received Sequence"):
        ObservationMap(spaces.Tuple([spaces.Discrete(2), spaces.Dict({"a": spaces.Sequence(spaces.Discrete(2))})]))


class Parallel:
    """Looks like an environment of PettingZoo."""

    possible_agents = ("a", "b")


gymnasium.register("Parallel-v0", entry_point=Parallel)
gymnasium.register("Vector-v0", entry_point=lambda: gymnasium.make_vec("CartPole-v1", num_envs=2))


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("Parallel-v0", "for one of PettingZoo, write a gymnasium.Env .* received Parallel from Parallel-v0"),
        ("Vector-v0", "not a vector of them: --environments says how many are played at once, received CartPoleVectorEnv"),
        (f"{__name__}:Vector-v0", "not a vector of them: .* received CartPoleVectorEnv from test_hidden_state:Vector-v0"),
    ],
)
def test_environments_of_other_kinds_get_a_hint(name, reason):
    with pytest.raises(ValueError, match=f"env_id: expected an environment of Gymnasium with one agent.*{reason}"):
        EnvironmentFactory(name).make()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("Nothing-v0", "an id of Gymnasium, .* received Nothing-v0: Environment `Nothing` doesn't exist"),
        ("nothing:Nothing-v0", "an id of Gymnasium, .* received nothing:Nothing-v0: No module named 'nothing'"),
        ("pettingzoo.mpe:simple_v3", "an id of Gymnasium, .*; for one of PettingZoo, write a gymnasium.Env"),
    ],
)
def test_unknown_environments_are_named(name, reason):
    with pytest.raises(ValueError, match=f"env_id: expected {reason}"):
        EnvironmentFactory(name).make()


def test_environments_in_the_place_of_ids_are_refused():
    """With the hints that their ids would get."""
    with pytest.raises(ValueError, match="env_id: expected an id of Gymnasium, .* received an environment, TimeLimit"):
        EnvironmentFactory(gymnasium.make("hidden_state:Spring-v0"))
    with pytest.raises(ValueError, match="not a vector of them: --environments says"):
        EnvironmentFactory(gymnasium.make_vec("CartPole-v1", num_envs=2))
    with pytest.raises(ValueError, match="for one of PettingZoo, write a gymnasium.Env"):
        EnvironmentFactory(Parallel())


# With a second argument, presses Ctrl-C when the training begins.
INTERRUPTED = """
import signal, sys
from spikeserve.__main__ import main
from spikeserve.imitation import training
if len(sys.argv) > 2:
    training.Spiketrain.train = lambda *_: signal.raise_signal(signal.SIGINT)
SMALL = "--environments=3 --steps=300 --hidden-size=16 --batch=2 --iterations=2 --rounds=0 --silence= --episodes=2"
FLAGS = [*SMALL.split(), "--selection-episodes=2", "--train-flags=--heads=2"]
sys.argv = ["spikeserve", "imitate", "hidden_state:Spring-v0", "--expert=hidden_state:hold", f"--out={sys.argv[1]}", *FLAGS]
sys.exit(main())
"""


def test_an_interrupted_run_continues(tmp_path):
    """SIGINT ends the program with one line; the same command continues."""
    command = [sys.executable, "-c", INTERRUPTED, str(tmp_path / "run")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    first = run(*command, "interrupt", status=130, env=environment)
    assert first.stderr.endswith("spikeserve imitate: interrupted; the same command continues\n")
    recorded = (tmp_path / "run/data/expert-v0/data/main_data.hdf5").read_bytes()
    again = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert again.returncode == 0, again.stderr[-2000:]
    assert (tmp_path / "run/data/expert-v0/data/main_data.hdf5").read_bytes() == recorded
    assert (tmp_path / "run/report.md").is_file()
