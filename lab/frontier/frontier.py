"""Compares spiking policies of one tick with rivals that read events, on EventWatch-v0: what equal returns cost, memory included.

    python lab/frontier/frontier.py --work=build/frontier --out=lab/frontier/runs.csv --spiketrain=build/release/bin/spiketrain

All learn from the same episodes of the expert and play the same unseen starts. A run that was interrupted continues. Rows of
files that are in the table already are kept, and those of other runs; --again plays and prices its own anew. Prints the
medians of the seeds, then the cheapest model of each kind that returns at least --level. PYTHONPATH needs lab/recipes, and
the engine of the Python client.
"""

import argparse
import csv
import functools
import hashlib
import itertools
import pathlib
import statistics
import subprocess

import event_watch
import numpy as np
import safetensors.numpy
from event_rivals import Cost, EventGru, EventPerceptron, PrunedGru, PrunedPerceptron, sram_price
from queue_baselines import read
from safetensors import safe_open
from spikeserve.engine import Engine
from spikeserve.imitation.actors import ExpertActor
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play
from spikeserve.imitation.experts import load_expert

PIXELS, INPUTS = event_watch.CAMERAS * event_watch.PIXELS, event_watch.CAMERAS * (event_watch.PIXELS + 1)
FIRST_START = 2_000_000
FIGURES = ("mean_return", "sram_nanojoules", "sram_nanojoules_by_event", "nanojoules", "spikes", "bytes")


def record(folder, episodes):
    """Writes episodes of the expert."""
    factory = EnvironmentFactory("event_watch:EventWatch-v0")
    played = play(factory.make, ExpertActor(load_expert(event_watch.expert)), iter(range(episodes)), 16)
    environment = factory.make()
    write_dataset(folder, sorted(played, key=lambda episode: episode.seed), environment, factory.name)
    environment.close()


def spiketrain(arguments, *command):
    program = [arguments.spiketrain.resolve(), *command]
    subprocess.run(program, cwd=arguments.work, check=True, stdout=subprocess.DEVNULL)


def train(arguments, out, seed, iterations, *flags):
    """Trains a policy and returns its folder."""
    if not (arguments.work / out / "policy.safetensors").is_file():
        flags = [*flags, f"--seed={seed}", f"--iterations={iterations}", *arguments.train.split()]
        spiketrain(
            arguments, "train", "--data=expert-v0", f"--out={out}", "--no_baselines", "--episodes=1", "--resume", *flags
        )
    return out


def policies(arguments, mode, width, seed):
    """Trains policies, the later ones with a penalty on operations, and yields the penalty and the file in integers."""
    shape = [
        f"--mode={mode}",
        f"--hidden_size={width}",
        f"--context={arguments.context}",
        "--layers=1",
        "--ticks=1",
        "--heads=2",
    ]
    shape += ["--observation_changes=false", *([] if mode == "dense" else ["--norm=fade"])]
    loud = train(arguments, f"{mode}-{width}-{arguments.context}-{seed}", seed, arguments.iterations, *shape)
    for penalty in [0.0] if mode == "dense" else arguments.penalties:
        stage = loud
        if penalty:
            flags = [f"--init={loud}/policy.safetensors", f"--operation_penalty={penalty}", *arguments.quiet.split()]
            stage = train(arguments, f"{loud}-{penalty}", seed, arguments.quiet_iterations, *flags)
        integers = arguments.work / stage / "integer.safetensors"
        if not integers.is_file():
            changed(integers.with_name("policy.safetensors"), integers.with_name("centred.safetensors"), centre)
            files = [f"--policy={stage}/centred.safetensors", f"--out={stage}/integer.safetensors", "--data=expert-v0"]
            prune = [] if mode == "dense" else ["--prune"]
            spiketrain(arguments, "quantize", "--to=integer", "--allow_loss", *prune, *files)
        yield penalty, integers


def changed(source, target, change):
    """Returns the file of a policy whose tensors `change` has changed."""
    if target.is_file():  # metadata have no order, so another one would have another digest
        return target
    with safe_open(source, framework="np") as file:
        tensors, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    change(tensors)
    safetensors.numpy.save_file(tensors, target, metadata)
    return target


def centre(tensors):
    """Makes a policy in float32 subtract the mean of observations in a bias, so that an input of 0 stays 0 and is skipped."""
    mean = tensors["observation.mean"] / tensors["observation.std"]
    tensors["embed.state.bias"] = (tensors["embed.state.bias"] - tensors["embed.state.weight"] @ mean).astype(
        np.float32
    )
    tensors["observation.mean"] = np.zeros_like(mean)


def silence(tensors):
    """Makes a policy in integers that never fires. No policy of its sizes costs less."""
    for name in (name for name in tensors if name.endswith("coder.threshold")):
        tensors[name] = np.full_like(tensors[name], np.iinfo(np.int16).max)


def rivals(arguments, kind, width, seed, episodes):
    """Trains rivals, each pruned from the one before, and yields the share of pruned weights and the file."""
    paths = {share: arguments.work / f"{kind}-{width}-{share}-{seed}.npz" for share in arguments.pruned}
    if not all(path.is_file() for path in paths.values()):
        model, data = new_rival(kind, width, seed, episodes())
        for share, path in paths.items():
            model.prune(share)
            model.train(*data, arguments.epochs if share == 0 else arguments.epochs / 2)
            largest = [] if kind == "gru" else [value.max() for value in model.outputs(data[0])[1:-1]]
            np.savez(path, *model.arrays, largest=largest)
    yield from paths.items()


def new_rival(kind, width, seed, episodes):
    """Returns a model and its data."""
    if kind == "gru":
        return PrunedGru(INPUTS, width, event_watch.ZONES, seed), (episodes,)
    frames = [np.hstack([seen[:, :PIXELS].cumsum(0), seen[:, PIXELS:]]) for seen, _ in episodes]
    model = PrunedPerceptron([INPUTS, width, width, event_watch.ZONES], seed)
    return model, (np.concatenate(frames), np.concatenate([labels for _, labels in episodes]))


def rival_player(kind, path):
    with np.load(path) as file:
        largest, arrays = file["largest"], [file[f"arr_{i}"] for i in range(len(file.files) - 1)]
    return EventGru(*arrays) if kind == "gru" else EventPerceptron(arrays, largest, PIXELS)


class PolicyPlayer:
    """Plays a policy in integers with the engine."""

    def __init__(self, path):
        self._engine = Engine(path)
        weights = {
            name: w.size
            for name, w in safetensors.numpy.load_file(path).items()
            if name.endswith("weight") and w.ndim == 2
        }
        self.bytes = sum(weights.values())
        price = sram_price(sum(size for name, size in weights.items() if name.startswith("layers")))
        self._input_price = price * weights["embed.state.weight"] / INPUTS

    def begin(self):
        self._session = self._engine.session()

    def act(self, observation, reward, cost):
        decision = self._session.act(observation, reward)
        stats = decision.stats
        cost.spikes += stats.spikes
        cost.arithmetic += 1e12 * stats.int_energy_joules
        cost.memory += 1e12 * (stats.int_sram_energy_joules - stats.int_energy_joules)
        cost.idle_inputs += (
            np.count_nonzero(observation == 0) * self._input_price
        )  # the account reads the whole embedding
        return decision.action


def score(player, starts):
    """Returns the figures of a model on unseen starts, those of cost for one decision."""
    environment, cost, total, decisions = event_watch.EventWatch(), Cost(), 0.0, 0
    for seed in range(FIRST_START, FIRST_START + starts):
        player.begin()
        (observation, _), reward, over = environment.reset(seed=seed), 0.0, False
        while not over:
            observation, reward, over, _, _ = environment.step(player.act(observation, reward, cost))
            total, decisions = total + reward, decisions + 1
    joules = cost.arithmetic + cost.memory
    costs = [value / decisions / 1000 for value in (joules, joules - cost.idle_inputs, cost.arithmetic)]
    return dict(zip(FIGURES, (total / starts, *costs, cost.spikes / decisions, player.bytes), strict=True))


def contestants(arguments):
    """Yields kind, width, seed, setting (a penalty, or a share of pruned weights), the file, and a function that loads it."""
    if not (arguments.work / "expert-v0").is_dir():
        record(arguments.work / "expert-v0", arguments.data_episodes)
    episodes = functools.cache(lambda: read([arguments.work / "expert-v0"]))  # only to train
    for seed in range(1, arguments.seeds + 1):
        for kind, width in itertools.product(("gru", "perceptron"), arguments.rival_widths):
            for setting, path in rivals(arguments, kind, width, seed, episodes):
                yield kind, width, seed, setting, path, lambda path, kind=kind: rival_player(kind, path)
        for width, mode in itertools.product(arguments.widths, arguments.modes):
            for setting, path in policies(arguments, mode, width, seed):
                if setting == 0 and mode == "baseline":  # phase generators fire, whatever the coders do
                    silent = changed(path, path.with_name("silent.safetensors"), silence)
                    yield "silent", width, seed, setting, silent, PolicyPlayer
                yield mode, width, seed, setting, path, PolicyPlayer


def medians(rows):
    """Returns the medians over the seeds of each model."""
    groups = {}
    for row in rows:
        model = row["kind"], int(row["width"]), int(row["context"]), float(row["setting"])
        groups.setdefault(model, []).append(row)
    return {
        m: {f: statistics.median(float(row[f]) for row in group) for f in FIGURES}
        for m, group in sorted(groups.items())
    }


def cheapest(table, level):
    """Returns the model of each kind that costs least with memory among those that return at least `level`."""
    good = [model for model in table if table[model]["mean_return"] >= level]
    return {
        kind: min((m for m in good if m[0] == kind), key=lambda m: table[m]["sram_nanojoules"]) for kind, *_ in good
    }


def print_table(rows, level):
    table = medians(rows)
    for model, figures in table.items():
        print("|", " | ".join([*map(str, model), *(f"{figures[name]:.3g}" for name in FIGURES)]), "|")
    for kind, model in cheapest(table, level).items():
        print(f"cheapest {kind} with {level:g}:", *model[1:], *(f"{table[model][name]:.3g}" for name in FIGURES))


def identity(row):
    """Returns what tells a row from the others. A run keeps those of other runs in its table."""
    return tuple(str(row[name]) for name in ("kind", "width", "context", "seed", "setting"))


def numbers(kind):
    return lambda text: [kind(number) for number in text.split(",") if number]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("work", "out", "spiketrain"):
        parser.add_argument(f"--{name}", required=True, type=pathlib.Path)
    parser.add_argument("--again", action="store_true", help="play and price what is in the table, too")
    parser.add_argument("--level", default=0.9, type=float, help="return at which costs are compared")
    for name, default in (("seeds", 3), ("data_episodes", 800), ("starts", 250), ("epochs", 40)):
        parser.add_argument(f"--{name}", default=default, type=int)
    for name, default in (("iterations", 1500), ("quiet_iterations", 1000)):
        parser.add_argument(f"--{name}", default=default, type=int, help="of policies")
    parser.add_argument("--modes", default=["baseline", "dense"], type=lambda text: text.split(","), help="of policies")
    parser.add_argument("--context", default=8, type=int, help="steps that policies see; an episode has 24")
    parser.add_argument("--widths", default=[32, 16], type=numbers(int), help="of policies")
    parser.add_argument("--penalties", default=[0.0, 0.1], type=numbers(float), help="on operations of policies")
    parser.add_argument(
        "--train", default="--learning_rate=0.005 --slope=4 --action_noise=0.5", help="flags of trainings"
    )
    parser.add_argument(
        "--quiet", default="--target_rate=5 --readout_rate=20", help="flags of trainings with a penalty"
    )
    parser.add_argument("--rival_widths", default=[16, 32], type=numbers(int))
    parser.add_argument("--pruned", default=[0.0, 0.75], type=numbers(float), help="shares of weights, first 0")
    arguments = parser.parse_args()
    arguments.work = arguments.work.resolve()
    arguments.work.mkdir(parents=True, exist_ok=True)
    table = {}
    if arguments.out.is_file():
        table = {identity(row): row for row in csv.DictReader(arguments.out.read_text().splitlines())}
    played = {(row["sha256"], int(row["starts"])): row for row in table.values() if not arguments.again}
    for kind, width, seed, setting, path, load in contestants(arguments):
        row = {
            "kind": kind,
            "width": width,
            "context": 0 if kind in ("gru", "perceptron") else arguments.context,
            "seed": seed,
            "setting": setting,
            "first_start": FIRST_START,
            "starts": arguments.starts,
        }
        row["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        known = played.get((row["sha256"], arguments.starts))
        table[identity(row)] = known or row | score(load(path), arguments.starts)
        with arguments.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, next(iter(table.values())), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table.values())
    rows = list(table.values())
    print_table(rows, arguments.level)


if __name__ == "__main__":
    main()
