"""Exported populations run in snnTorch, and NeuroBench counts on the same spikes what spiketrain counts.

Simulators run in an environment of their own, tests/chips, because Debian's PyTorch needs NumPy 1.
"""

import json
import os
import pathlib
import re
import subprocess

import numpy as np
import pytest
import spikeserve
from documentation import page_of
from exported_populations import check_imported, exported_policies
from integer_engine import IntegerEngine
from policy_file import read_policy
from serving import SHIPPED_POLICIES, run, running_server
from spikeserve.export import to_nir

STEPS = 12
NAMES = sorted(path.name for path in SHIPPED_POLICIES.iterdir())
SIMULATE = pathlib.Path(__file__).parents[2] / "chips/simulate.py"
IMPORTERS = SIMULATE.with_name("importers.py")
NEXT_TO_THRESHOLD = 2e-5  # of all neurons and ticks


class Recorder(IntegerEngine):
    """Keeps the input and output spikes of every population, token by token."""

    def __init__(self, tensors, metadata):
        super().__init__(tensors, metadata)
        self.recorded = {}

    def _fire(self, name, inputs, stage):
        spikes = super()._fire(name, inputs, stage)
        self.recorded.setdefault(name, []).append((inputs, spikes))
        return spikes

    def inputs(self, name):
        return np.stack([inputs for inputs, _ in self.recorded[name]]).astype(int)

    def outputs(self, name):
        return np.stack([outputs for _, outputs in self.recorded[name]])


def shipped(name):
    return SHIPPED_POLICIES / name / "1/policy.safetensors"


def encode(space, action):
    if isinstance(space, spikeserve.Discrete):
        return np.eye(space.n)[action]
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    return 2 * (np.asarray(action, np.float64) - low) / (high - low) - 1


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Plays a recorded episode with every shipped policy. Returns Recorders and recordings, by policy."""
    folder = tmp_path_factory.mktemp("recordings")
    models, recordings = {}, {}
    with running_server(flags=[f"--record_dir={folder}"]) as server, spikeserve.Client(server.grpc) as client:
        for name in NAMES:
            tensors, metadata = read_policy(shipped(name))
            models[name] = Recorder(tensors, metadata)
            random = np.random.default_rng(1)
            mean, std = tensors["observation.mean"], tensors["observation.std"]
            last = None
            with client.open_session(name, spikeserve.SessionOptions(record=True, version=1)) as session:
                for _ in range(STEPS):
                    observation = (mean + 1.5 * std * random.normal(size=len(mean))).astype(np.float32)
                    decision = session.act(observation, 1.0)
                    models[name].decide(decision.return_to_go, observation, last)
                    last = encode(session.opening.action_space, decision.action)
                session.end_episode(1.0, truncated=True)
                recordings[name] = folder / session.opening.recording
    return models, recordings


@pytest.fixture(scope="module")
def simulated(played, tmp_path_factory):
    """Runs every population in snnTorch. Returns its spikes and NeuroBench's metrics, by policy and population."""
    folder = tmp_path_factory.mktemp("nir")
    for name, model in played[0].items():
        exported = to_nir(shipped(name))
        exported.write(folder / name)
        assert set(exported.populations) == set(model.recorded)
        np.savez(folder / name / "spikes.npz", **{key: model.inputs(key) for key in model.recorded})
    folders = [str(folder / name) for name in NAMES]
    subprocess.run([os.environ["CHIPS_PYTHON"], str(SIMULATE), *folders], check=True)
    subprocess.run([os.environ["CHIPS_PYTHON"], str(IMPORTERS), "snntorch", *folders], check=True)
    return {
        name: (
            dict(np.load(folder / name / "fired.npz")),
            json.loads((folder / name / "metrics.json").read_text()),
            dict(np.load(folder / name / "snntorch.npz")),
        )
        for name in NAMES
    }


def fire_unrounded(model, name):
    """Returns the spikes of the integer neurons if membranes are not rounded, and fire without an input spike, too.

    They fire half a unit below the threshold, which a rounded membrane reaches from there.
    """
    weight, bias, threshold = (model.tensors[f"{name}.{part}"].astype(float) for part in ("weight", "bias", "threshold"))
    inputs = model.inputs(name)
    decay = model.config["membrane_decay"]
    membrane = np.zeros((len(inputs), len(bias)))
    spikes = np.zeros((*inputs.shape[:2], len(bias)), bool)
    for tick in range(inputs.shape[1]):
        membrane = membrane * decay + inputs[:, tick] @ weight.T + bias
        spikes[:, tick] = membrane > threshold - 0.5
        membrane[spikes[:, tick]] = 0
    return spikes


@pytest.mark.parametrize("name", NAMES)
def test_snntorch_fires_the_same_spikes_except_where_integers_differ(played, simulated, name):
    model, (fired, _, imported) = played[0][name], simulated[name]
    differing = total = 0
    for population, spikes in fired.items():
        expected = model.outputs(population)
        differing += int((spikes != expected).sum())
        total += int(expected.sum())
        unrounded = fire_unrounded(model, population)
        # A sum that is next to the threshold may fall on either side of it in float32.
        for ours in (spikes, imported[population]):
            assert (ours != unrounded).mean() <= NEXT_TO_THRESHOLD, f"{population}: these are not the only causes"
    print(f"{name}: {differing} of {total} spikes differ, all because membranes are rounded, or lack an input")
    assert differing <= 0.3 * total


def test_snntorch_imports_every_version(tmp_path):
    """Its own importer, on random spikes: what it makes fires as the equations of each policy file do."""
    policies = exported_policies(tmp_path)
    subprocess.run([os.environ["CHIPS_PYTHON"], str(IMPORTERS), "snntorch", *policies], check=True)
    check_imported(policies, "snntorch")


def neurobench(name, recordings):
    arguments = [f"--policy={shipped(name)}", f"--recordings={recordings[name]}", "--json"]
    return json.loads(run("spiketrain", "neurobench", *arguments).stdout)


@pytest.mark.parametrize("name", NAMES)
def test_spiketrain_counts_the_accumulates_that_neurobench_counts(played, simulated, name):
    models, recordings = played
    metrics = neurobench(name, recordings)
    assert metrics["decisions"] == STEPS
    # A sample of NeuroBench is a token here, and one of spiketrain a decision. The token of the last action is computed
    # after the last decision, so it is in neither.
    accumulates = sum(
        theirs["SynapticOperations"]["Effective_ACs"] * len(models[name].recorded[population])
        for population, theirs in simulated[name][1].items()
    )
    assert metrics["SynapticOperations"]["Effective_ACs"] * STEPS == pytest.approx(accumulates)
    assert all(theirs["SynapticOperations"]["Effective_MACs"] == 0 for theirs in simulated[name][1].values())


@pytest.mark.parametrize("name", NAMES)
def test_the_sparsities_and_the_footprint_are_those_of_the_file(played, simulated, name):
    models, recordings = played
    model, metrics = models[name], neurobench(name, recordings)
    assert metrics["Footprint"] == sum(tensor.nbytes for tensor in model.tensors.values())
    maps = [tensor for key, tensor in model.tensors.items() if key.endswith(".weight") and tensor.ndim == 2]
    zeros = sum(int((tensor == 0).sum()) for tensor in maps)
    assert metrics["ConnectionSparsity"] == pytest.approx(zeros / sum(tensor.size for tensor in maps))
    for population, theirs in simulated[name][1].items():
        weight = model.tensors[f"{population}.weight"]
        assert theirs["ConnectionSparsity"] == pytest.approx((weight == 0).mean(), abs=1e-4)
        fired = simulated[name][0][population]
        assert theirs["ActivationSparsity"] == pytest.approx(1 - fired.mean())
    assert 0.5 < metrics["ActivationSparsity"] < 1


def test_the_examples_of_the_page_print_its_table(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(SIMULATE.parents[2])
    page = page_of("chips.md").read_text()
    names = {}
    for example in re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        exec(example.replace("/tmp/cartpole-nir", str(tmp_path / "nir")), names)
    exported, *table = capsys.readouterr().out.splitlines()
    assert exported == "8 populations, 1060 neurons"
    assert sorted(path.suffix for path in (tmp_path / "nir").iterdir()) == [".json"] + [".nir"] * 8
    for row in table:
        assert row in page
    assert len(table) == len(NAMES)
