"""Runs exported populations in networks that the simulators' own importers make of them.

usage: importers.py IMPORTER FOLDER...: reads the export of a policy and its spikes.npz, as simulate.py does. Writes the
spikes to IMPORTER.npz, [tokens, T, out] by population. IMPORTER is snntorch or spikingjelly.
"""

import contextlib
import io
import json
import pathlib
import sys

import nir
import numpy as np
import torch


def snntorch(graph, tick_seconds):
    """Reads no time of a step: its own is that of every export."""
    from snntorch.import_nir import import_from_nir

    assert tick_seconds == 1e-4
    with contextlib.redirect_stdout(io.StringIO()):  # it prints what it does
        return import_from_nir(graph)


def spikingjelly(graph, tick_seconds):
    from spikingjelly.activation_based.nir_exchange.from_nir import import_from_nir

    return import_from_nir(graph, dt=tick_seconds)


def run(network, inputs):
    """Returns the spikes of every tick; membranes start at 0 for every token."""
    state, fired = None, []
    for tick in range(inputs.shape[1]):
        spikes, state = network(inputs[:, tick], state)
        fired.append(np.array(spikes.tolist(), bool))
    return np.stack(fired, axis=1)


def main():
    importer = {"snntorch": snntorch, "spikingjelly": spikingjelly}[sys.argv[1]]
    for folder in map(pathlib.Path, sys.argv[2:]):
        manifest = json.loads((folder / "manifest.json").read_text())
        recorded = np.load(folder / "spikes.npz")
        fired = {}
        for name, entry in manifest["populations"].items():
            inputs = torch.tensor(recorded[name].tolist(), dtype=torch.float32)
            network = importer(nir.read(folder / entry["file"]), manifest["tick_seconds"])
            with torch.no_grad():
                fired[name] = run(network, inputs)
        np.savez(folder / f"{sys.argv[1]}.npz", **fired)


if __name__ == "__main__":
    main()
