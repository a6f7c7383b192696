"""The parts of `spikeserve.imitate`: spaces, experts, recordings, and a run that is interrupted and continued."""

import hashlib
import json
import os
import pathlib
import sys
import types

import gymnasium
import h5py
import home_made
import minari
import numpy as np
import pytest
import spikeserve
from gymnasium import spaces
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from spikeserve.flat_spaces import ActionMap, FlatEnvironment, ObservationMap
from spikeserve.imitation.actors import Bursts, ExpertActor, RandomActor
from spikeserve.imitation.baselines import return_warnings
from spikeserve.imitation.datasets import read_dataset, write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play
from spikeserve.imitation.experts import load_expert
from spikeserve.imitation.figures import Figures
from spikeserve.imitation.images import image_flags
from spikeserve.imitation.insight import Insight, drift, learning_curves
from spikeserve.imitation.options import ImitationOptions
from spikeserve.imitation.pipeline import has_stalled

SPIKETRAIN = os.environ["SPIKETRAIN"]
SMALLEST = ImitationOptions(
    environments=3,
    steps=400,
    hidden_size=16,
    batch=2,
    iterations=3,
    rounds=1,
    round_steps=100,
    round_iterations=2,
    silence=((3.0, 15.0),),
    silence_iterations=2,
    tolerance=10.0,
    selection_episodes=3,
    episodes=4,
    context=4,
    train_flags=("--heads=2",),
)

ACTION_SPACES = [
    spaces.Discrete(3),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 3, 4]),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary(3),
    spaces.Box(np.array([-1.0, 0.0]), np.array([3.0, 0.5]), dtype=np.float64),
    spaces.Box(-2, 2, (2, 3), np.float32),
    spaces.Box(0, 10, (2,), np.int64),
]


@pytest.mark.parametrize("space", ACTION_SPACES, ids=str)
def test_actions_keep_their_meaning(space):
    actions = ActionMap(space)
    space.seed(0)
    for _ in range(20):
        native = space.sample()
        flat = actions.to_flat(native)
        assert actions.space.contains(flat) or actions.space.contains(np.int64(flat))
        back = actions.to_native(flat)
        assert space.contains(back)
        np.testing.assert_allclose(np.asarray(back, np.float64), np.asarray(native, np.float64), atol=1e-6)
    if isinstance(actions.space, spaces.Discrete):
        everything = {str(actions.to_native(index)) for index in range(actions.space.n)}
        assert len(everything) == actions.space.n


def test_the_last_element_of_a_multidiscrete_changes_fastest():
    actions = ActionMap(spaces.MultiDiscrete([2, 3]))
    assert [actions.to_native(i).tolist() for i in range(6)] == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]]


@pytest.mark.parametrize(
    ("space", "size"),
    [
        (spaces.Box(-1, 1, (2, 3), np.float64), 6),
        (spaces.Box(0, 255, (4, 4, 1), np.uint8), 16),
        (spaces.Discrete(3, start=2), 3),
        (spaces.MultiDiscrete([2, 3]), 5),
        (spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Tuple([spaces.Discrete(2), spaces.MultiBinary(3)])}), 7),
    ],
    ids=str,
)
def test_observations_are_flattened_as_gymnasium_does(space, size):
    observations = ObservationMap(space)
    space.seed(0)
    sample = space.sample()
    flat = observations.flatten(sample)
    assert (flat.dtype, flat.shape, observations.size) == (np.float32, (size,), size)
    np.testing.assert_array_equal(flat, np.asarray(spaces.flatten(space, sample), np.float32).ravel())


@pytest.mark.parametrize(
    ("make", "space", "reason"),
    [
        (ObservationMap, spaces.Graph(spaces.Discrete(2), None), "observation_space: expected Box, Discrete"),
        (ObservationMap, spaces.Sequence(spaces.Discrete(2)), "observation_space: expected Box, Discrete"),
        (
            ObservationMap,
            spaces.Box(0, 255, (1024, 1024, 3), np.uint8),
            "observation_space: expected at most 1048576 numbers, received 3145728",
        ),
        (ActionMap, spaces.Dict({"a": spaces.Discrete(2)}), "action_space: expected Discrete, MultiDiscrete"),
        (ActionMap, spaces.Box(-np.inf, np.inf, (2,)), "action_space: expected finite bounds"),
        (ActionMap, spaces.MultiDiscrete([100, 100]), "expected at most 4096 combinations, received 10000"),
    ],
    ids=str,
)
def test_spaces_are_refused_by_name(make, space, reason):
    with pytest.raises(ValueError, match=reason):
        make(space)


def flat_home_made():
    return FlatEnvironment(gymnasium.make("home_made:HomeMade-v0"))


def test_bursts_disturb_actions_and_not_labels():
    expert = load_expert("home_made:go_to_corner")
    actor = ExpertActor(expert, Bursts(seed=1, disturbed=0.5, rate=0.5, longest=3))
    episodes = list(play(flat_home_made, actor, iter(range(20)), environments=4))
    undisturbed = list(play(flat_home_made, ExpertActor(expert), iter(range(20)), environments=4))
    shares = [np.mean(np.array(e.actions) != np.array(e.labels)) for e in episodes]
    assert 3 < sum(share > 0 for share in shares) < 17
    assert np.mean([e.episode_return for e in episodes]) < np.mean([e.episode_return for e in undisturbed])
    by_seed = {e.seed: e.actions for e in play(flat_home_made, actor, iter(range(20)), environments=1)}
    assert by_seed == {e.seed: e.actions for e in episodes}, "the number of environments changes nothing"


def test_a_dataset_is_read_as_it_was_written(tmp_path):
    actor = ExpertActor(load_expert("home_made:go_to_corner"), Bursts(1, 1.0, 0.5, 3))
    written = list(play(flat_home_made, actor, iter(range(3)), environments=2))
    write_dataset(tmp_path / "home-v0", written, flat_home_made(), "HomeMade-v0")
    read = list(read_dataset(tmp_path / "home-v0"))
    for mine, theirs in zip(written, read, strict=True):
        assert mine.actions == theirs.actions
        assert mine.labels == theirs.labels
        np.testing.assert_array_equal(mine.observations, theirs.observations)
        np.testing.assert_allclose(mine.rewards, theirs.rewards)
        assert (theirs.terminated, theirs.truncated) == (False, True)


def test_images_are_recorded_in_bytes(tmp_path):
    make = EnvironmentFactory("home_made:Picture-v0").make
    written = list(play(make, ExpertActor(load_expert("home_made:go_to_dot")), iter(range(3)), environments=2))
    write_dataset(tmp_path / "picture-v0", written, make(), "Picture-v0")
    with h5py.File(tmp_path / "picture-v0/data/main_data.hdf5") as file:
        stored = file["episode_0/observations"]
        assert (stored.dtype, stored.shape) == (np.uint8, (17, 16 * 16 * 3))
    for mine, theirs in zip(written, read_dataset(tmp_path / "picture-v0"), strict=True):
        np.testing.assert_array_equal(mine.observations, theirs.observations)
        assert theirs.observations[0].dtype == np.uint8


def record_with_minari(folder):
    """Records the native spaces of HomeMade-v0 as Minari's own collector stores them."""
    environment = gymnasium.make("home_made:HomeMade-v0")
    (folder / "data").mkdir(parents=True)
    storage = MinariStorage.new(
        folder / "data",
        observation_space=environment.observation_space,
        action_space=environment.action_space,
        env_spec=environment.spec,
    )
    buffers = []
    for seed in range(4):
        observation, _ = environment.reset(seed=seed)
        observations, actions, rewards = [observation], [], []
        for _ in range(20):
            actions.append(home_made.go_to_corner(observation))
            observation, reward, *_ = environment.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
        nested = {key: np.array([o[key] for o in observations]) for key in observations[0]}
        ends = [False] * 19 + [True]
        buffers.append(EpisodeBuffer(seed, seed, None, nested, actions, rewards, [False] * 20, ends))
    storage.update_episodes(buffers)
    storage.update_metadata({"dataset_id": folder.name, "minari_version": minari.__version__})


def digest(path):
    return hashlib.sha256(pathlib.Path(path).read_bytes()).hexdigest()


def test_a_run_continues_and_one_seed_gives_one_policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ("home_made:HomeMade-v0", home_made.go_to_corner)
    first = spikeserve.imitate(*arguments, tmp_path / "a", options=SMALLEST, spiketrain=SPIKETRAIN)
    second = spikeserve.imitate(*arguments, "b", options=SMALLEST, spiketrain=SPIKETRAIN)
    stage = "stages/3-silence-3/policy.safetensors"
    first_weights, second_weights = (read_weights(tmp_path / run / stage) for run in "ab")
    for name, values in first_weights.items():
        np.testing.assert_array_equal(values, second_weights[name], err_msg=name)
    assert first.figures.returns == second.figures.returns
    # Loses the last stages, as an interruption does, and continues.
    for lost in ("stages/3-silence-3.json", "evaluations/version-2.json", "report.md"):
        (tmp_path / "a" / lost).unlink()
    before = digest(tmp_path / "a/data/expert-v0/data/main_data.hdf5")
    again = spikeserve.imitate(*arguments, tmp_path / "a", options=SMALLEST, spiketrain=SPIKETRAIN)
    assert digest(tmp_path / "a/data/expert-v0/data/main_data.hdf5") == before
    assert again.quantized_figures == first.quantized_figures
    report = again.report.read_text()
    assert report.startswith("# HomeMade-v0, imitating home_made:go_to_corner\n")
    assert "| `2-round1` |" in report
    engine = spikeserve.engine.Engine(again.quantized)
    assert (engine.arithmetic, engine.environment) == ("integer", "HomeMade-v0")
    assert engine.training_return == pytest.approx(again.quantized_figures.mean)
    record = json.loads(engine.training)
    assert record["imitation"]["steps"] == 400
    assert again.policy.stat().st_mode & 0o777 == 0o644
    assert record["parent_sha256"] == digest(again.policy)
    assert not any(str(tmp_path) in stage["command"] for stage in [record, *record["lineage"]])
    with pytest.raises(ValueError, match="out: expected the settings of .* received other seed"):
        other = ImitationOptions(**(vars(SMALLEST) | {"seed": 1}))
        spikeserve.imitate(*arguments, tmp_path / "a", options=other, spiketrain=SPIKETRAIN)


def read_weights(path):
    import safetensors.numpy

    return safetensors.numpy.load_file(path)


def test_a_dataset_of_minari_is_imitated(tmp_path):
    record_with_minari(tmp_path / "corner-expert-v0")
    result = spikeserve.imitate(
        "home_made:HomeMade-v0",
        tmp_path / "corner-expert-v0",
        tmp_path / "run",
        options=SMALLEST,
        spiketrain=SPIKETRAIN,
    )
    assert len(result.expert_figures.returns) == 4
    stages = sorted(path.name for path in (tmp_path / "run/stages").glob("*.json"))
    assert stages == ["1-play.json", "2-silence-3.json"], "a dataset cannot label the policy's states"


@pytest.mark.parametrize(
    ("returns", "patience", "stalled"),
    [([3, 2], 1, True), ([3, 4], 1, False), ([3, 2], 2, False), ([3, 2, 4], 2, False), ([3, 2, 3], 2, True), ([3, 2, 1], 0, False)],
)
def test_rounds_end_after_returns_that_are_no_better(returns, patience, stalled):
    assert has_stalled(returns, patience) == stalled


def test_patience_ends_a_run_early(tmp_path):
    many = ImitationOptions(**(vars(SMALLEST) | {"rounds": 5, "patience": 1, "silence": (), "episodes": 2}))
    arguments = ("home_made:HomeMade-v0", home_made.go_to_corner)
    spikeserve.imitate(*arguments, tmp_path, options=many, spiketrain=SPIKETRAIN)
    stages = ["1-play", *(f"{i + 1}-round{i}" for i in range(1, 6))]
    figures = [tmp_path / f"evaluations/{stage}.json" for stage in stages]
    returns = [json.loads(path.read_text())["mean_return"] for path in figures if path.is_file()]
    assert not any(has_stalled(returns[:count], 1) for count in range(1, len(returns)))
    assert has_stalled(returns, 1) or len(returns) == 6


def test_the_best_of_several_first_trainings_is_continued(tmp_path):
    several = ImitationOptions(**(vars(SMALLEST) | {"seeds": 3, "silence": (), "episodes": 2}))
    arguments = ("home_made:HomeMade-v0", home_made.go_to_corner)
    spikeserve.imitate(*arguments, tmp_path, options=several, spiketrain=SPIKETRAIN)
    first = ["1-play", "2-play", "3-play"]
    returns = [json.loads((tmp_path / f"evaluations/{stage}.json").read_text())["mean_return"] for stage in first]
    assert len(set(returns)) > 1, "each has other random weights"
    record = json.loads(spikeserve.engine.Engine(tmp_path / "stages/4-round1/policy.safetensors").training)
    best = tmp_path / "stages" / first[int(np.argmax(returns))] / "policy.safetensors"
    assert record["parent_sha256"] == digest(best)
    spread = f"{np.mean(returns):.3f} ± {np.std(returns, ddof=1):.3f}"
    assert f"3 first trainings differ only in their seeds. Mean and standard deviation of their returns: {spread}" in (
        (tmp_path / "report.md").read_text()
    )


IMAGE = spaces.Box(0, 255, (28, 20, 3), np.uint8)


@pytest.mark.parametrize(
    ("space", "patch_size", "expected"),
    [
        (IMAGE, None, ["--image_shape=28,20,3", "--patch_size=4"]),
        (IMAGE, 2, ["--image_shape=28,20,3", "--patch_size=2"]),
        (IMAGE, 0, []),
        (spaces.Box(0, 255, (21, 14, 3), np.uint8), None, ["--image_shape=21,14,3", "--patch_size=7"]),
        (spaces.Box(0, 255, (11, 13, 3), np.uint8), None, []),
        (spaces.Box(0, 10, (7, 7, 3), np.uint8), None, []),
        (spaces.Box(0, 1, (16, 16, 3), np.float32), None, []),
        (spaces.Discrete(3), None, []),
    ],
    ids=str,
)
def test_images_are_embedded_in_patches_that_fill_them(space, patch_size, expected):
    assert image_flags(space, patch_size) == expected


def test_one_start_has_no_spread_that_could_make_a_difference_significant():
    def figures(*returns):
        return Figures(list(returns), decisions=1, spikes=0)

    assert figures(1.0).falls_by(figures(3.0)) == (2.0, np.inf)
    assert figures(1.0, 1.0).falls_by(figures(2.0, 4.0)) == (2.0, 1.0)
    assert return_warnings(figures(1.0), {"a line": figures(9.0)}) == []
    assert return_warnings(figures(1.0, 1.0), {"a line": figures(2.0, 4.0)}) == []
    (warning,) = return_warnings(figures(1.0, 1.0), {"a line": figures(3.0, 4.0)})
    assert warning == "a line returns more than the policy on the same 2 starts: by 2.5 ± 0.5"


def test_trainings_without_held_out_episodes_have_no_curve(tmp_path):
    assert learning_curves([tmp_path / "1-play"]) == []


def test_no_policy_is_good_whose_expert_is_no_better_than_chance():
    chance = Figures([10.0], decisions=1, spikes=0)
    for share, grade in ((None, "bad"), (0.4, "bad"), (0.5, "weak"), (0.95, "good")):
        insight = Insight(None, None, None, share, chance, [])
        assert insight.verdict().grade == grade
        assert ("Imitate an expert that returns more than random actions." in insight.advice(False, 5)) == (share is None)


def test_the_drift_closes_its_environments():
    opened = []

    class Tracked(gymnasium.Wrapper):
        def __init__(self, environment):
            super().__init__(environment)
            opened.append(self)

        def close(self):
            opened.remove(self)
            super().close()

    expert = load_expert(home_made.balance)
    drift(EnvironmentFactory("CartPole-v1", [Tracked]), ExpertActor(expert), range(2))
    assert opened == []


def test_wrappers_change_the_environment_and_its_name(tmp_path):
    factory = EnvironmentFactory("CartPole-v1", [home_made.Backwards], max_episode_steps=7)
    assert factory.name == "CartPole-v1-Backwards"
    plain, _ = gymnasium.make("CartPole-v1").reset(seed=3)
    environment = factory.make()
    observation, _ = environment.reset(seed=3)
    np.testing.assert_array_equal(observation, plain[::-1])
    (episode,) = play(factory.make, RandomActor(0), iter([3]), 1)
    assert episode.steps == 7 and episode.truncated
    write_dataset(tmp_path / "backwards-v0", [episode], environment, factory.name)
    (read,) = read_dataset(tmp_path / "backwards-v0")
    assert read.actions == episode.actions


def test_experts_of_stable_baselines_are_loaded(tmp_path, monkeypatch):
    """Uses a stand-in for the package, because it needs PyTorch: the calls are those of its documentation."""

    class Model:
        @classmethod
        def load(cls, path, device):
            assert (pathlib.Path(path).name, device) == ("expert.zip", "cpu")
            return cls()

        def predict(self, observation, deterministic):
            assert deterministic
            return np.array(home_made.go_to_corner(observation)), None

    package = types.ModuleType("stable_baselines3")
    package.PPO = Model
    monkeypatch.setitem(sys.modules, "stable_baselines3", package)
    file = tmp_path / "expert.zip"
    file.write_bytes(b"")
    environment = flat_home_made()
    environment.reset(seed=0)
    action = load_expert(f"PPO:{file}")(environment)
    np.testing.assert_array_equal(action, home_made.go_to_corner(environment.native_observation))
    with pytest.raises(ValueError, match="expected an algorithm of stable_baselines3, received XYZ"):
        load_expert(f"XYZ:{file}")


@pytest.mark.parametrize(
    ("expert", "reason"),
    [
        ("home_made:nothing", "expert: expected an importable module:name, received home_made:nothing"),
        ("home_made:FIRST_CORNER", "expert: expected a callable, received 1"),
        (lambda a, b, c: 0, "3 required parameters"),
    ],
)
def test_experts_are_refused(expert, reason):
    with pytest.raises(ValueError, match=reason):
        load_expert(expert)


@pytest.mark.parametrize(("script", "network", "activation"), [("ppo", "actor", np.tanh), ("dqn", "network", None)])
def test_experts_of_cleanrl_are_loaded(tmp_path, monkeypatch, script, network, activation):
    """Uses a stand-in for PyTorch, which only reads the file. The names of the tensors are those of CleanRL's scripts."""
    random = np.random.default_rng(0)
    sizes = [(0, 8, 6), (2, 5, 8), (4, 9, 5)]  # index of the layer, outputs, inputs
    tensors = {f"{network}.{i}.weight": random.normal(size=(rows, columns)) for i, rows, columns in sizes}
    tensors |= {f"{network}.{i}.bias": random.normal(size=rows) for i, rows, _ in sizes}
    tensors["critic.0.weight"] = np.zeros((2, 2))
    stand_in = types.ModuleType("torch")
    stand_in.load = lambda path, map_location, weights_only: tensors
    monkeypatch.setitem(sys.modules, "torch", stand_in)
    file = tmp_path / "expert.cleanrl_model"
    file.write_bytes(b"")
    environment = FlatEnvironment(gymnasium.make("Acrobot-v1"))
    observation, _ = environment.reset(seed=0)
    act = load_expert(f"{script}:{file}")
    hidden = observation
    for i, _, _ in sizes[:-1]:
        hidden = tensors[f"{network}.{i}.weight"] @ hidden + tensors[f"{network}.{i}.bias"]
        hidden = activation(hidden) if activation else np.maximum(hidden, 0)
    assert act(environment) == np.argmax(tensors[f"{network}.4.weight"] @ hidden + tensors[f"{network}.4.bias"])
    other = {"ppo": "dqn", "dqn": "ppo"}[script]
    with pytest.raises(ValueError, match=f"expected a file of {other}.py"):
        load_expert(f"{other}:{file}")
    with pytest.raises(ValueError, match="expected ppo or dqn before a file of CleanRL, received ppo_continuous_action"):
        load_expert(f"ppo_continuous_action:{file}")
