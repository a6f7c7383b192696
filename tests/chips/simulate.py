"""Runs exported populations in snnTorch, and NeuroBench's metrics over them, on recorded spikes.

usage: simulate.py FOLDER...: reads the export of a policy and its spikes.npz, whose array NAME holds the input spikes of a
population, [tokens, T, in]. Writes the spikes of snnTorch to fired.npz, [tokens, T, out], and NeuroBench's metrics of each
population to metrics.json.

Runs in the Python environment of tests/chips/requirements.txt, whose torch is Debian's.
"""

import json
import pathlib
import sys

import nir
import numpy as np
import snntorch
import torch
from neurobench.benchmarks import Benchmark
from neurobench.metrics.static import ConnectionSparsity
from neurobench.metrics.workload import ActivationSparsity, SynapticOperations
from neurobench.models import SNNTorchModel


class Population(torch.nn.Module):
    """An Affine node and a LIF node of NIR as layers of snnTorch, in float64."""

    def __init__(self, graph, tick_seconds):
        super().__init__()
        affine, lif = graph.nodes["affine"], graph.nodes["lif"]
        beta = 1 - tick_seconds / lif.tau
        assert np.allclose((1 - beta) * lif.r, 1) and not np.any(lif.v_leak) and not np.any(lif.v_reset)
        self.affine = torch.nn.Linear(affine.weight.shape[1], affine.weight.shape[0]).double()
        with torch.no_grad():
            self.affine.weight.copy_(torch.tensor(affine.weight.tolist()))
            self.affine.bias.copy_(torch.tensor(affine.bias.tolist()))
        self.lif = snntorch.Leaky(
            beta=torch.tensor(beta.tolist(), dtype=torch.float64),
            threshold=torch.tensor(lif.v_threshold.tolist(), dtype=torch.float64),
            reset_mechanism="zero",
            reset_delay=False,
            init_hidden=True,
            output=True,
        )

    def forward(self, spikes):
        return self.lif(self.affine(spikes))


def measure(graph, tick_seconds, inputs):
    """Returns the spikes that the population fires, and NeuroBench's metrics with a token as a sample."""
    model = SNNTorchModel(Population(graph, tick_seconds))
    spikes = torch.tensor(inputs.tolist(), dtype=torch.float64)
    samples = torch.utils.data.TensorDataset(spikes, torch.zeros(len(spikes)))
    loader = torch.utils.data.DataLoader(samples, batch_size=len(spikes))
    with torch.no_grad():
        fired = np.array(model(spikes).tolist(), bool)
        metrics = [[ConnectionSparsity], [ActivationSparsity, SynapticOperations]]
        return fired, Benchmark(model, loader, [], [], metrics).run(quiet=True)


def main():
    for folder in map(pathlib.Path, sys.argv[1:]):
        manifest = json.loads((folder / "manifest.json").read_text())
        recorded = np.load(folder / "spikes.npz")
        fired, metrics = {}, {}
        for name, entry in manifest["populations"].items():
            graph = nir.read(folder / entry["file"])
            fired[name], metrics[name] = measure(graph, manifest["tick_seconds"], recorded[name])
        np.savez(folder / "fired.npz", **fired)
        (folder / "metrics.json").write_text(json.dumps(metrics, default=float))


if __name__ == "__main__":
    main()
