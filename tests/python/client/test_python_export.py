"""A real server reads the policy files that spikeserve.export writes."""

import json
import os
import shutil
import stat

import gymnasium
import numpy as np
import pytest
import safetensors
import safetensors.numpy
import spikeserve
from random_policy import SMALL, export_random, random_tensors
from serving import RELEASED_POLICIES, SHIPPED_POLICIES, running_server
from spikeserve.export import ModelConfig, export_policy, tensor_shapes, to_nir

SMALL_POLICY = RELEASED_POLICIES / "cartpole-sparse/1/policy.safetensors"
SHAPES = [
    *({"mode": mode} for mode in ModelConfig.CHOICES["mode"]),
    {"mode": "full", "merge": "concat", "gate": "sigmoid", "phase_clock": "window"},
    {"mode": "pos", "layers": 1, "heads": 4},
    {"mode": "route", "routing_hidden_size": 3, "ffn_size": 7, "threshold": 0.5},
    *({"mode": mode, "observation_changes": True} for mode in ("full", "dense")),
    {"mode": "full", "norm": "none"},
    {"mode": "full", "arithmetic": "integer"},
]


class TorchTensor:
    """Has the methods of a PyTorch tensor that the exporter calls. NumPy cannot convert it."""

    def __init__(self, array):
        self._array = array
        self._steps = []

    def detach(self):
        self._steps.append("detach")
        return self

    def cpu(self):
        self._steps.append("cpu")
        return self

    def numpy(self):
        assert self._steps == ["detach", "cpu"]
        return self._array


def read(path):
    with safetensors.safe_open(path, framework="numpy") as file:
        return file.metadata(), safetensors.numpy.load_file(path)


def play(client, policy):
    """Plays more steps than the context holds. Returns the actions, probabilities and spikes."""
    random = np.random.default_rng(0)
    with client.open_session(policy) as session:
        decisions = [session.act(random.normal(0, 0.1, 4), reward=1.0) for _ in range(40)]
    return [(d.action, d.action_probabilities.tolist(), d.stats.spikes) for d in decisions]


def test_the_server_plays_an_exported_policy_as_the_original(tmp_path):
    metadata, tensors = read(SMALL_POLICY)
    numbers = ["return_offset", "return_scale", "target_return", "modulator_mean", "modulator_std"]
    path = tmp_path / "copy" / "1" / "policy.safetensors"
    export_policy(
        path,
        {name: TorchTensor(tensor) for name, tensor in tensors.items()},
        ModelConfig(**json.loads(metadata["config"])),
        action_space=gymnasium.spaces.Discrete(2),
        environment="CartPole-v1",
        training=json.loads(metadata["training"]),
        **{name: float(metadata[name]) for name in numbers},
    )
    assert os.listdir(path.parent) == ["policy.safetensors"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    (tmp_path / "original" / "1").mkdir(parents=True)
    shutil.copy(SMALL_POLICY, tmp_path / "original" / "1")
    with running_server(tmp_path) as server, spikeserve.Client(server.grpc) as client:
        copy, original = client.list_policies()
        assert vars(copy) | {"name": "original"} == vars(original)
        answers = play(client, "copy")
        assert answers == play(client, "original")
    assert {action for action, _, _ in answers} == {0, 1}


def test_the_server_reads_every_mode(tmp_path):
    for index, shape in enumerate(SHAPES):
        for env_id in ("CartPole-v1", "Pendulum-v1"):
            with gymnasium.make(env_id) as environment:
                export_random(tmp_path, f"{env_id}-{index}", environment, **shape)
    with running_server(tmp_path) as server, spikeserve.Client(server.grpc) as client:
        served = client.list_policies()
        assert len(served) == 2 * len(SHAPES)
        for policy in served:
            assert policy.mode == SHAPES[int(policy.name.rpartition("-")[2])]["mode"]
            with client.open_session(policy.name) as session:
                for _ in range(12):
                    session.act(np.ones(policy.observation_size), reward=1.0)


def test_a_box_policy_acts_within_its_bounds(tmp_path):
    with gymnasium.make("Pendulum-v1") as environment:
        export_random(tmp_path, "p", environment)
    with running_server(tmp_path) as server, spikeserve.Client(server.grpc) as client:
        (policy,) = client.list_policies()
        assert policy.action_space == spikeserve.Box((-2.0,), (2.0,))
        with client.open_session("p") as session:
            decision = session.act([0.5, 0.5, 1.0])
    assert decision.action.dtype == np.float32
    assert decision.action.shape == (1,)
    assert -2 <= decision.action[0] <= 2
    assert decision.action_probabilities is None


def test_tensor_names_and_shapes_are_those_of_a_trained_policy():
    metadata, tensors = read(SMALL_POLICY)
    shapes = tensor_shapes(ModelConfig(**json.loads(metadata["config"])), 4, 2)
    assert {name: tensor.shape for name, tensor in tensors.items()} == shapes


@pytest.mark.parametrize(
    "path", sorted(SHIPPED_POLICIES.glob("*/*/*.safetensors")), ids=lambda p: "/".join(p.parts[-3:-1])
)
def test_policies_in_integers_have_names_and_shapes(path):
    metadata, tensors = read(path)
    config = ModelConfig(**json.loads(metadata["config"]))
    actions, observations = len(tensors["head.bias"]), len(tensors["observation.mean"])
    assert {name: tensor.shape for name, tensor in tensors.items()} == tensor_shapes(config, observations, actions)


CONFIG = ModelConfig(**SMALL)
FIELDS = {"action_space": spikeserve.Discrete(2), "environment": "CartPole-v1", "target_return": 1}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "policy.safetensors"


def export_broken(path, name, tensor, space=FIELDS["action_space"]):
    size = space.n if isinstance(space, spikeserve.Discrete) else len(space.low)
    tensors = random_tensors(CONFIG, 4, size) | {name: tensor}
    export_policy(path, tensors, CONFIG, **(FIELDS | {"action_space": space}))


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("head.weight", np.ones((2, 17)), r"expected shape \[2, 16\], received \[2, 17\]"),
        ("head.bias", np.ones((2, 1)), r"expected shape \[2\], received \[2, 1\]"),
        ("head.bias", 1.0, r"expected shape \[2\], received \[\]"),
        ("layers.1.attention.key.weight", np.ones((16, 16)), r"\[16, 18\], received \[16, 16\]"),
        ("head.bias", [0, np.nan], "expected numbers finite in float32, received nan at index 1"),
        ("head.bias", [1e39, 0], "expected numbers finite in float32, received inf at index 0"),
        ("head.bias", ["a", "b"], "expected real numbers, received dtype <U1"),
        ("head.bias", [1j, 2], "expected real numbers, received dtype complex128"),
        ("head.bias", [[1], [2, 3]], r"expected real numbers, received list \(setting an array"),
        ("observation.std", [1, 0, 1, 1], "expected positive numbers, received 0.0 at index 1"),
        ("observation.mean", [], "expected at least one value, received 0"),
        ("head.scale", [1], "expected no such tensor in mode full, received one"),
    ],
)
def test_bad_tensors_are_refused_by_name(path, name, tensor, message):
    with pytest.raises(ValueError, match=f'tensor "{name}": .*{message}'):
        export_broken(path, name, tensor)
    assert os.listdir(path.parent) == []


NO_POLICIES = {
    "garbage": (lambda path: path.write_bytes(b"\xff" * 100), "expected a policy file, received another: "),
    "other": (lambda path: safetensors.numpy.save_file({"a": np.zeros(2)}, path), "expected a policy file, received another: "),
    "list": (lambda path: safetensors.numpy.save_file({"a": np.zeros(2)}, path, {"config": "[1]"}), "expected a policy file, received "),
    "empty": (lambda path: safetensors.numpy.save_file({}, path, {"config": "{}"}), "layers.0.attention.query.weight: expected a tensor"),
}


@pytest.mark.parametrize(("write", "reason"), NO_POLICIES.values(), ids=NO_POLICIES)
def test_nir_is_written_of_policies_alone(write, reason, tmp_path):
    write(tmp_path / "file.safetensors")
    with pytest.raises(ValueError, match=f"file.safetensors: {reason}"):
        to_nir(tmp_path / "file.safetensors")


@pytest.mark.parametrize("name", ["phase.omega", "observation.mean"])
def test_a_missing_tensor_is_refused_by_name(path, name):
    tensors = random_tensors(CONFIG, 4, 2)
    del tensors[name]
    with pytest.raises(ValueError, match=f'tensor "{name}": expected a tensor, received none'):
        export_policy(path, tensors, CONFIG, **FIELDS)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("return_scale", 0, "expected a positive finite number, received 0"),
        ("modulator_std", -1, "expected a positive finite number, received -1"),
        ("target_return", float("nan"), "expected a finite number, received nan"),
        ("return_offset", 1e39, "expected a finite number, received 1e+39"),
        ("action_space", spikeserve.Discrete(0), "expected at least 1, received 0"),
        ("action_space", spikeserve.Box((0.0,), (np.inf,)), "expected finite bounds"),
        ("action_space", spikeserve.Box((0.0,), (0.0,)), "low[0] < high[0], received 0.0 and 0.0"),
        ("action_space", spikeserve.Box((0.0,), ()), "of one length from 1, received 1 and 0"),
        ("action_space", gymnasium.spaces.Discrete(2, start=1), "expected Discrete from 0"),
        ("action_space", gymnasium.spaces.MultiBinary(2), "expected Discrete or Box"),
        ("training", {"mean": float("nan")}, "JSON"),
    ],
)
def test_bad_fields_are_refused_by_name(path, field, value, message):
    with pytest.raises(ValueError, match=field) as error:
        export_policy(path, random_tensors(CONFIG, 4, 2), CONFIG, **(FIELDS | {field: value}))
    assert message in str(error.value)
    assert os.listdir(path.parent) == []


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("mode", "dens", "expected one of baseline, pos, route, full, dense, received 'dens'"),
        ("heads", 3, "expected a multiple of heads = 3, received 128"),
        ("layers", 0, "expected an integer from 1 to 64, received 0"),
        ("ticks", 2.5, "expected an integer from 1 to 256, received 2.5"),
        ("membrane_decay", 1.5, "expected 0 to 1, received 1.5"),
        ("threshold", 0.0, "expected a positive finite number, received 0.0"),
        ("threshold", 1e-60, "expected a positive finite number, received 1e-60"),
        ("arithmetic", "int4", "expected one of float32, integer, received 'int4'"),
        ("norm", "batch", "expected one of layer, none, received 'batch'"),
    ],
)
def test_a_bad_config_is_refused_by_field(field, value, message):
    with pytest.raises(ValueError) as error:
        ModelConfig(**{field: value})
    assert str(error.value).endswith(message)
    assert str(error.value).startswith("hidden_size" if field == "heads" else field)


def test_a_dense_policy_has_norms():
    with pytest.raises(ValueError, match="norm: expected layer in mode dense, received 'none'"):
        ModelConfig(mode="dense", norm="none")


def test_a_policy_in_integers_is_checked_and_not_exported(path):
    integer = ModelConfig(**SMALL | {"arithmetic": "integer", "membrane_decay": 0.9375})
    with pytest.raises(ValueError, match="arithmetic: expected float32; `spiketrain quantize`"):
        export_policy(path, {}, integer, **FIELDS)
    for changes, field in (
        ({"membrane_decay": 0.95}, "membrane_decay"),
        ({"membrane_decay": 0.9375, "leak": "none"}, "leak"),
        ({"membrane_decay": 0.9375, "coder": "bernoulli"}, "coder"),
        ({"membrane_decay": 0.9375, "input_fraction": 15}, "input_fraction"),
    ):
        with pytest.raises(ValueError, match=f"^{field}: expected"):
            ModelConfig(arithmetic="integer", **changes)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(path, monkeypatch):
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        export_policy(path, random_tensors(CONFIG, 4, 2), CONFIG, **FIELDS)
    assert path.read_bytes() == b"old"
    assert os.listdir(path.parent) == [path.name]
