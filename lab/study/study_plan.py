"""What the study trains: tasks (study_tasks.py), arms that differ in nothing but attention, and seeds.

A seed decides the data, the initial weights and the order of the clips. All arms of a seed have the same data.
"""

import dataclasses

from study_tasks import ALL_TASKS, FIELD_TASKS, GROUPS, STRUCTURED_TASKS, TASKS_OF_SETTINGS, TASKS_OF_THE_PAPER

FIRST_UNSEEN_SEED = 2_000_000  # starts of the evaluation
FIRST_SELECTION_SEED = 1_000_000  # starts by which the learning rate of `dense` is chosen
STARTS_OF_A_SEED = 4_000  # seed 3 records its data from the environment's start 12,000 on
RATES = ("3e-4", "1e-3", "3e-3")  # of `dense`
SWEEP_SEEDS = (101, 102)
SEEDS = 10
FEW_SEEDS = 3  # of the field and the structured tasks
SHARES = {"quarter": 0.25, "half": 0.5}  # of the iterations
COMMON = (
    *("--hidden_size=64", "--ticks=8", "--slope=4", "--observation_changes=false", "--no_baselines", "--episodes=1"),
    "--validate_every=100",
)


@dataclasses.dataclass(frozen=True)
class Clone:
    """A model without attention that imitates: a perceptron on a queue of observations, or a gated recurrent unit."""

    hidden: int  # of both layers, or of the state; 0: a line
    recurrent: bool = False
    best: float = 1.0  # share of the episodes, by their returns

    @property
    def flags(self):
        return (f"--hidden={self.hidden}", *(["--recurrent"] if self.recurrent else []), f"--best={self.best:g}")


CLONES_OF_FIELD = {"cloning": Clone(256), "cloning-10": Clone(256, best=0.1), "recurrent": Clone(64, recurrent=True)}
CLONES_OF_STRUCTURED = {
    "line": Clone(0),
    **{f"perceptron-{hidden}": Clone(hidden) for hidden in (64, 256)},
    **{f"recurrent-{hidden}": Clone(hidden, recurrent=True) for hidden in (64, 256)},
}
CLONES = CLONES_OF_FIELD | CLONES_OF_STRUCTURED
FIELD_ARMS = ("dense", "baseline", "full", "quiet", *CLONES_OF_FIELD)
STRUCTURED_ARMS = (*CLONES_OF_STRUCTURED, "dense", "spiking")


@dataclasses.dataclass(frozen=True)
class Arm:
    """What a run has of its own. Another length of the clips keeps the steps of a batch."""

    mode: str = "full"
    flags: tuple[str, ...] = ()
    clip: int | None = None  # steps
    share: float = 1.0  # of the task's iterations
    priced: bool = False  # in integers, as it is served


MODES = ("dense", "baseline", "pos", "route", "full")  # the ordinary decision transformer, and the paper's
MODES_OF_SHARES = ("baseline", "pos", "full")  # of shorter trainings

# The modes, and `full` trained with a context of one step, which has no past.
ARMS = {mode: Arm(mode, priced=True) for mode in MODES}
ARMS["full-n1"] = Arm(flags=("--context=1",), priced=True)
# `full` with one thing changed, `baseline` with biases by distance, and shorter trainings.
PARTS = {
    "surrogate-sigmoid": Arm(flags=("--surrogate=sigmoid",)),
    "surrogate-piecewise": Arm(flags=("--surrogate=piecewise_linear",)),
    **{f"ticks-{ticks}": Arm(flags=(f"--ticks={ticks}",)) for ticks in (5, 10, 20, 40)},
    **{f"context-{context}": Arm(flags=(f"--context={context}",), clip=context) for context in (20, 50, 100)},
    "gate-sigmoid": Arm(flags=("--gate=sigmoid",)),
    "router-activity": Arm(flags=("--gate=sigmoid", "--routing_hidden_size=4", "--activity_router")),
    "baseline-bias": Arm("baseline", flags=("--relative_bias=true",), priced=True),
    "clock-window": Arm(flags=("--phase_clock=window",)),
    "phase-frozen": Arm(flags=("--freeze=phase",)),
    "head-frozen": Arm(flags=("--freeze=head",)),
    **{
        f"{name}-{place}-{rate}": Arm(flags=(f"--local_rate={rate}", f"--local_rule={rule}", *flags))
        for name, rule in (("hebbian", "hebbian"), ("score", "policy_gradient"))
        for place, flags in (("beside", ()), ("instead", ("--freeze=head",)))
        for rate in ("1e-3", "1e-2")  # the range of the paper
    },
    "long": Arm(clip=64, share=4),
    "tick-1": Arm(flags=("--ticks=1",), clip=64, share=4, priced=True),  # a tick costs an eighth
    **{f"{mode}-{name}": Arm(mode, share=share) for name, share in SHARES.items() for mode in MODES_OF_SHARES},
}
PART_TASKS = ("cartpole", "pendulum", "repeat-4")  # the shortest
# A mode that is trained with penalties on spikes and operations, on the sets of the field.
QUIET = {"quiet": Arm("baseline", flags=("--target_rate=4", "--readout_rate=15", "--operation_penalty=0.02"), priced=True)}
# A mode that each structured task may change.
SPIKING = {"spiking": Arm("baseline", priced=True)}
ARMS_OF_TRAINING = ARMS | PARTS | QUIET | SPIKING


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a run may cost besides its training."""

    steps: int | None = None  # of data; None: those of the task
    starts: int = 100  # that a policy plays
    share_of_epochs: float = 1.0  # of a model without attention
    further: tuple[str, ...] = ()  # flags of `spiketrain train`, after those of the task


SMOKE = Budget(
    steps=300,
    starts=2,
    share_of_epochs=0.005,
    further=("--hidden_size=16", "--heads=4", "--ffn_size=16", "--ticks=2", "--batch=2", "--iterations=2", "--clip_steps=8"),
)


@dataclasses.dataclass(frozen=True)
class Run:
    """One policy to train. A run with a rate belongs to the sweep of `dense`."""

    task: str
    arm: str
    seed: int
    rate: str | None = None

    @property
    def name(self):
        """Returns `cartpole-full-3`; also the name of its folder."""
        return "-".join([self.task, self.arm, *([f"rate{self.rate}"] if self.rate else []), str(self.seed)])

    @property
    def plan(self):
        """Returns its task's plan."""
        return ALL_TASKS[self.task]

    @property
    def group(self):
        """Returns the name of the table of its result."""
        return "sweep" if self.rate else next(group for group, tasks in GROUPS.items() if self.task in tasks)

    @property
    def first_start(self):
        return FIRST_SELECTION_SEED if self.rate else FIRST_UNSEEN_SEED


def sweep_runs(tasks):
    """Returns the runs that choose the learning rate of `dense`, on those of the tasks that do not say it."""
    open_tasks = [task for task in tasks if not ALL_TASKS[task].rate_of_dense]
    return [Run(task, "dense", seed, rate) for seed in SWEEP_SEEDS for task in open_tasks for rate in RATES]


def study_runs(tasks, seeds):
    """Returns the runs of the study: all of a seed before the next, so that a study that has not ended is balanced.

    The paper's tasks have the modes alone. Arms that are no modes come last in a seed.
    """
    others = [arm for arm in ARMS if arm not in MODES]
    cells = [(task, mode) for task in tasks for mode in MODES]
    cells += [(task, arm) for task in tasks if task not in TASKS_OF_THE_PAPER for arm in others]
    return [Run(task, arm, seed) for seed in range(1, seeds + 1) for task, arm in cells]


def part_runs(tasks, seeds):
    """Returns the runs of the parts, in the same order."""
    return [Run(task, arm, seed) for seed in range(1, seeds + 1) for task in tasks if task in PART_TASKS for arm in PARTS]


def settings_runs():
    """Returns the runs with the paper's settings, all of a setting before the next. They have one seed, as the paper's."""
    return [Run(task, mode, 1) for task in TASKS_OF_SETTINGS for mode in MODES]


def field_runs():
    """Returns the runs on the sets of the field, all of a seed before the next."""
    return [Run(task, arm, seed) for seed in range(1, FEW_SEEDS + 1) for task in FIELD_TASKS for arm in FIELD_ARMS]


def structured_sweep_runs():
    """Returns the runs that choose the learning rate of `dense` on structured tasks that have none."""
    return sweep_runs(STRUCTURED_TASKS)


def structured_runs():
    """Returns the runs on the structured tasks, in the same order."""
    return [Run(task, arm, seed) for seed in range(1, FEW_SEEDS + 1) for task in STRUCTURED_TASKS for arm in STRUCTURED_ARMS]


def train_flags(run, rate, budget):
    """Returns the flags of `spiketrain train` for a run, without data and folder. `rate` is the learning rate."""
    if run.arm in CLONES:
        return [f"--seed={run.seed}", *CLONES[run.arm].flags, *run.plan.cloning.flags]
    task, arm = run.plan, ARMS_OF_TRAINING[run.arm]
    flags = [f"--mode={arm.mode}", f"--seed={run.seed}", *COMMON, *task.flags, f"--learning_rate={rate}"]
    if arm.mode != "dense":
        flags += task.spiking
    number = {flag.partition("=")[0]: int(flag.partition("=")[2]) for flag in task.flags if flag.partition("=")[2].isdigit()}
    context = next((int(flag.partition("=")[2]) for flag in arm.flags if flag.startswith("--context=")), number["--context"])
    if task.lookback is not None and arm.mode in ("pos", "full") and task.lookback < context:
        flags.append(f"--lookback={task.lookback}")
    if arm.clip is not None:
        steps = number["--batch"] * number["--clip_steps"]
        flags += [f"--clip_steps={arm.clip}", f"--batch={max(1, steps // arm.clip)}"]
    if arm.share != 1:
        flags.append(f"--iterations={round(arm.share * number['--iterations'])}")
    return without_repetition([*flags, *budget.further, *arm.flags])


def flags_through(flags):
    """Returns the flags of `spiketrain train` that continue a run through the integers, for a quarter of its iterations."""
    kept = ("--seed", "--slope", "--batch", "--clip_steps", "--action_noise", "--no_baselines", "--validate_every")
    values = {flag.partition("=")[0]: flag.partition("=")[2] for flag in flags}
    optimiser = ("--learning_rate=3e-4", "--warmup=10", f"--iterations={-(-int(values['--iterations']) // 4)}")
    return [*(flag for flag in flags if flag.partition("=")[0] in kept), *optimiser]


def is_former(run):
    """Returns whether a run needs biases by distance, which `spiketrain` had until commit d7cda46c."""
    return "--relative_bias=true" in train_flags(run, "", Budget())


def without_repetition(flags):
    """Returns the flags, of which the last with a name counts."""
    return list({flag.partition("=")[0]: flag for flag in flags}.values())
