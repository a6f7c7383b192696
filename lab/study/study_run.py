"""One run of the study: records the data of its seed, trains, plays unseen starts, and serves the policy in integers.

Served is what plain rounding makes, or, if the gate of `spiketrain quantize` refuses that, what training through it makes.
"""

import contextlib
import csv
import fcntl
import hashlib
import json
import subprocess
import time

import offline_sets
import study_plan
from spikeserve.engine import Engine
from spikeserve.imitation.actors import Bursts, ExpertActor, StudentActor
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory, load_object
from spikeserve.imitation.episodes import Choice, play
from spikeserve.imitation.experts import load_expert
from spikeserve.imitation.figures import Figures
from study_cloning import fit

ENVIRONMENTS = 16  # of Gymnasium, played at once
TIMED_STARTS = 5  # by which the latency is measured where spiketrain plays
# The figures of a policy in integers, and the energy models of their estimates: with memory, and without.
ENERGIES = {"int_sram_nanojoules_per_decision": "int_sram_45nm", "int_nanojoules_per_decision": "int_45nm"}
LARGEST_LOSS = 0.01  # of the range, beyond chance: the gate of `spiketrain quantize`


class PricedActor(StudentActor):
    """Plays a policy in integers, and adds up the energies and the seconds of its decisions."""

    def __init__(self, engine):
        super().__init__(engine)
        self._sums = dict.fromkeys([*ENERGIES, "microseconds_per_decision"], 0.0)

    def per_decision(self, decisions):
        return {name: total / decisions for name, total in self._sums.items()}

    def choose(self, rows):
        return [self._priced(row) for row in rows]

    def _priced(self, row):
        decision = self._session(row).act(row.episode.observations[-1], row.reward)
        stats = decision.stats
        self._sums["int_sram_nanojoules_per_decision"] += 1e9 * stats.int_sram_energy_joules
        self._sums["int_nanojoules_per_decision"] += 1e9 * stats.int_energy_joules
        self._sums["microseconds_per_decision"] += 1e6 * stats.compute_seconds
        return Choice(decision.action, spikes=stats.spikes)


class Workshop:
    """Runs the programs in a folder, which holds data and policies.

    `spiketrain` is the program, `sets` a folder of datasets; `plays_longer` plays further contexts, too.
    """

    def __init__(self, folder, spiketrain, budget, sets=None, plays_longer=True):
        self._folder = folder
        self._spiketrain = spiketrain
        self._budget = budget
        self._sets = sets
        self._plays_longer = plays_longer

    def carry_out(self, run, rate):
        """Returns the result of a run, an object for JSON. Continues a training that was interrupted."""
        task = run.plan
        data = self._data(run, task)
        flags = study_plan.train_flags(run, rate, self._budget)
        if run.arm in study_plan.CLONES:
            return self._clone(run, data, flags)
        policy = f"{run.name}/policy.safetensors"
        with locked(self._folder / f"{run.name}.lock"):
            if not (self._folder / policy).is_file():
                self._program("train", f"--data={data}", f"--out={run.name}", "--resume", *flags)
        result = {"task": run.task, "arm": run.arm, "seed": run.seed, "learning_rate": rate, "training": " ".join(flags)}
        result["sha256"] = self._digest(policy)
        if run.rate is None and study_plan.ARMS_OF_TRAINING[run.arm].priced and not task.settings:
            result |= self._serve(run, policy, data, flags)
        else:
            result |= self._play(task, policy, run.first_start)
        losses = self._losses(run.name)
        if losses:
            result["validation_loss"] = list(losses.values())[-1]
        if task.settings:
            return result | {"losses": {iteration // task.settings.epoch: loss for iteration, loss in losses.items()}}
        if self._plays_longer and run.rate is None and run.arm in study_plan.ARMS:
            result |= self._play_longer(task, policy, run)
        return result

    def _clone(self, run, data, flags):
        """Returns the result of a model without attention."""
        with contextlib.closing(factory_of(run.plan).make()) as environment:
            space = environment.action_space
        clone, share = study_plan.CLONES[run.arm], self._budget.share_of_epochs
        actor, multiplications = fit(clone, run.plan.cloning, self._folder / data, run.seed, share, space)
        result = {"task": run.task, "arm": run.arm, "seed": run.seed, "learning_rate": "", "training": " ".join(flags)}
        result |= self._play_with(run.plan, actor, run.first_start)
        return result | {"multiplications": multiplications}

    def _losses(self, name):
        """Returns the validation losses of a training by iteration."""
        with (self._folder / name / "learning_curve.csv").open() as file:
            return {int(line["iteration"]): float(line["validation_loss"]) for line in csv.DictReader(file)}

    def _program(self, *arguments):
        command = [self._spiketrain, *arguments]
        finished = subprocess.run(command, cwd=self._folder, check=False, capture_output=True, text=True)
        if finished.returncode != 0:
            raise RuntimeError(f"{' '.join(command)}: status {finished.returncode}\n{finished.stderr[-2000:]}")
        return finished.stdout

    # Data

    def _data(self, run, task):
        """Records the data of a seed, once for all arms. Returns the path in the folder, or that of a set."""
        if task.dataset:
            self._sets.mkdir(parents=True, exist_ok=True)
            with locked(self._sets / f"{task.environment}.lock"):
                if not (self._sets / task.dataset).exists():
                    offline_sets.make_sets(task.environment, self._sets, task.steps)
            return self._sets / task.dataset
        name = f"data/{run.task}-{run.seed}"
        data = f"{name}-v0" if task.is_gymnasium else f"{name}.cbor"
        (self._folder / "data").mkdir(exist_ok=True)
        with locked(self._folder / f"{name}.lock"):
            if not (self._folder / data).exists():
                self._record(run, task, data)
        return data

    def _record(self, run, task, data):
        steps = self._budget.steps or task.steps
        if task.is_gymnasium:
            factory = factory_of(task)
            actor = ExpertActor(load_expert(task.expert), Bursts(run.seed, task.disturbed, *task.bursts))
            seeds = Starts(run.seed * study_plan.STARTS_OF_A_SEED, steps)
            episodes = [seeds.counted(episode) for episode in play(factory.make, actor, seeds, ENVIRONMENTS)]
            with contextlib.closing(factory.make()) as environment:
                write_dataset(self._folder / data, episodes, environment, factory.name)
            return
        partial = data.replace(".cbor", ".partial.cbor")
        flags = [*task.data, f"--steps={steps}", f"--seed={run.seed}"]
        self._program("dataset", f"--env={task.environment}", *flags, "--tables=data", f"--out={partial}")
        (self._folder / partial).rename(self._folder / data)

    # Figures

    def _play(self, task, policy, first_start):
        starts = self._budget.starts
        if not task.is_gymnasium:
            return self._play_own(policy, first_start, starts)
        return self._play_with(task, StudentActor(Engine(self._folder / policy)), first_start)

    def _play_with(self, task, actor, first_start):
        return self._figures(play_starts(task, actor, first_start, self._budget.starts), first_start)

    def _figures(self, figures, first_start):
        return {
            "first_start": first_start,
            "starts": self._budget.starts,
            "mean_return": figures.mean,
            "std_return": figures.std,
            "spikes_per_decision": figures.spikes_per_decision,
        }

    def _play_own(self, policy, first_start, starts):
        figures, _ = self._evaluate(policy, first_start, starts)
        result = {"first_start": first_start, "starts": starts} | own_figures(figures)
        prices = figures["estimated_energy_joules_per_decision"]
        return result | self._latency(policy, first_start) if ENERGIES["int_nanojoules_per_decision"] in prices else result

    def _evaluate(self, policy, first_start, starts):
        """Returns the figures of `spiketrain eval`, and the seconds that it took."""
        began = time.perf_counter()
        figures = self._program("eval", f"--policy={policy}", f"--episodes={starts}", f"--seed={first_start}", "--json")
        return json.loads(figures), time.perf_counter() - began

    def _latency(self, policy, first_start):
        """Returns the time of a decision on the first starts: what those after the first one take."""
        first, seconds = self._evaluate(policy, first_start, 1)
        figures, longer = self._evaluate(policy, first_start, 1 + TIMED_STARTS)
        return {"microseconds_per_decision": 1e6 * (longer - seconds) / (figures["decisions"] - first["decisions"])}

    def _play_longer(self, task, policy, run):
        """Returns the mean returns in contexts that are longer than that of the training, by context."""
        if run.arm == "full-n1" or not task.longer:
            return {}
        longer = policy.replace("policy.", "longer.")
        means = {}
        for context in task.longer:
            write_with_context(self._folder / policy, context, self._folder / longer)
            means[str(context)] = self._play(task, longer, run.first_start)["mean_return"]
        return {"longer": means}

    # Integers

    def _serve(self, run, policy, data, flags):
        """Returns the figures of the policy, and in integers; where its plain rounding is refused, those of both integers.

        The gate and the table have the same starts.
        """
        rounded = policy.replace("policy.", "rounded.")
        command = ["quantize", "--to=integer", f"--policy={policy}", f"--out={rounded}", f"--data={data}", "--json"]
        if run.plan.is_gymnasium:
            self._program(*command, "--max_loss=1")
            before = play_starts(run.plan, StudentActor(Engine(self._folder / policy)), run.first_start, self._budget.starts)
            result = self._figures(before, run.first_start)
            result["integer"] = self._priced_gymnasium(run, rounded, before, command)
        else:
            starts = (f"--episodes={self._budget.starts}", f"--seed={run.first_start}")
            played = json.loads(self._program(*command, *starts, "--allow_loss"))
            result = {"first_start": run.first_start, "starts": self._budget.starts}
            result |= {"mean_return": played["mean_returns"][0], "spikes_per_decision": played["spikes_per_decision"][0]}
            evaluation = json.loads(metadata(self._folder / rounded)["training"])["evaluation"]
            figures = own_figures(evaluation) | self._latency(rounded, run.first_start)
            result["integer"] = self._gate(rounded, played["verdict"]["rounding_loss"]) | starts_of(evaluation) | figures
        if not result["integer"]["refused"] or run.arm == "dense":  # which is trained in float32 alone
            return result
        result["rounded"] = result["integer"]
        trained = self._train_through(run, policy, data, flags)
        if run.plan.is_gymnasium:
            judge = ["quantize", f"--policy={policy}", f"--data={data}", f"--out={run.name}/judged.safetensors", "--json"]
            return result | {"integer": self._priced_gymnasium(run, trained, before, judge)}
        loss = self._lost_by(run, policy, trained, result["rounded"])
        return result | {"integer": self._gate(trained, loss) | self._play_own(trained, run.first_start, self._budget.starts)}

    def _train_through(self, run, policy, data, flags):
        """Trains a policy through its rounding. Returns the file."""
        folder = f"{run.name}/integer"
        command = ["train", "--arithmetic=integer", f"--init={policy}", f"--data={data}", f"--out={folder}", "--overwrite"]
        self._program(*command, *study_plan.flags_through(flags), "--episodes=1", "--allow_loss")
        return f"{folder}/policy.safetensors"

    def _priced_gymnasium(self, run, integer, before, quantize):
        """Returns the figures of a policy in integers in an environment of Gymnasium. `quantize` judges by returns, as its rule is."""
        actor = PricedActor(Engine(self._folder / integer))
        after = play_starts(run.plan, actor, run.first_start, self._budget.starts)
        returns = f"{run.name}/returns.json"
        played = {"before": before.returns, "after": after.returns, "random": [run.plan.chance]}
        (self._folder / returns).write_text(json.dumps(played))
        loss = json.loads(self._program(*quantize, f"--returns={returns}", "--allow_loss"))["verdict"]["rounding_loss"]
        result = self._gate(integer, loss) | self._figures(after, run.first_start)
        return result | actor.per_decision(after.decisions)

    def _lost_by(self, run, policy, integer, rounded):
        """Returns what integers lose in one of spiketrain's environments, in the words of its rule."""
        files = (f"--policy={integer}", f"--against={policy}")
        starts = (f"--episodes={self._budget.starts}", f"--seed={run.first_start}")
        pair = json.loads(self._program("eval", *files, *starts, "--json"))["paired_returns"]
        low, high = (-end / rounded["range"] for end in reversed(pair["difference_95_percent"]))
        share = -pair["mean_difference"] / rounded["range"]
        return {"share": share, "share_95_percent": [low, high], "range": rounded["range"]}

    def _gate(self, integer, loss):
        """Returns the digest of integers, what they lost of the policy's range above chance, and whether the gate refuses them."""
        refused = loss["share"] > LARGEST_LOSS and loss["share_95_percent"][0] > 0
        figures = {"lost": loss["share"], "range": loss["range"], "refused": int(refused)}
        return {"sha256": self._digest(integer), **figures}

    def _digest(self, policy):
        return hashlib.sha256((self._folder / policy).read_bytes()).hexdigest()


def own_figures(evaluation):
    """Returns the figures of an evaluation by spiketrain, and the energies of a policy in integers."""
    prices = evaluation["estimated_energy_joules_per_decision"]
    energies = {name: 1e9 * prices[model] for name, model in ENERGIES.items() if model in prices}
    return {name: evaluation[name] for name in ("mean_return", "std_return", "spikes_per_decision")} | energies


def starts_of(evaluation):
    return {"first_start": evaluation["first_seed"], "starts": evaluation["episodes"]}


def header_of(data):
    """Returns the header of a policy file, and the size of its text."""
    size = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + size]), size


def metadata(policy):
    return header_of(policy.read_bytes())[0]["__metadata__"]


def write_with_context(policy, context, out):
    """Writes a policy file with another context. The weights do not depend on it."""
    data = policy.read_bytes()
    header, size = header_of(data)
    config = json.loads(header["__metadata__"]["config"]) | {"context": context}
    header["__metadata__"]["config"] = json.dumps(config)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    out.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])


class Starts:
    """Yields the environment's seeds from `first` on, until the finished episodes have a number of steps."""

    def __init__(self, first, steps):
        self._next, self._left = first, steps

    def __iter__(self):
        return self

    def __next__(self):
        if self._left <= 0:
            raise StopIteration
        self._next += 1
        return self._next - 1

    def counted(self, episode):
        self._left -= episode.steps
        return episode


@contextlib.contextmanager
def locked(path):
    """Waits until no other process does the same work."""
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def factory_of(task):
    return EnvironmentFactory(task.environment, [load_object(name, "wrapper") for name in task.wrappers])


def play_starts(task, actor, first, starts):
    seeds = iter(range(first, first + starts))
    return Figures.of(play(factory_of(task).make, actor, seeds, min(starts, ENVIRONMENTS)))
