"""What the study trains: tasks on which memory decides, arms that differ in nothing but attention, and seeds.

A seed decides the data, the initial weights and the order of the clips. All arms of a seed have the same data.
"""

import dataclasses
import math

WRAPPERS_OF_MEMORY = ("minigrid.wrappers:OneHotPartialObsWrapper", "minigrid.wrappers:ImgObsWrapper")
FIRST_UNSEEN_SEED = 2_000_000  # starts of the evaluation
FIRST_SELECTION_SEED = 1_000_000  # starts by which the learning rate of `dense` is chosen
STARTS_OF_A_SEED = 4_000  # seed 3 records its data from the environment's start 12,000 on
RATES = ("3e-4", "1e-3", "3e-3")  # of `dense`
SWEEP_SEEDS = (101, 102)
SEEDS = 10
SHARES = {"quarter": 0.25, "half": 0.5}  # of the iterations
COMMON = (
    *("--hidden_size=64", "--ticks=8", "--slope=4", "--observation_changes=false", "--no_baselines", "--episodes=1"),
    "--validate_every=100",
)


@dataclasses.dataclass(frozen=True)
class Task:
    """A task. `flags` are those of `spiketrain train` that all arms have. Returns are those of random actions and the expert."""

    environment: str  # of spiketrain, or `module:id` of Gymnasium
    flags: tuple[str, ...]
    rate: str  # the learning rate of spiking arms
    chance: float
    expert_return: float
    data: tuple[str, ...] = ()  # flags of `spiketrain dataset`, for its own environments
    steps: int = 20_000  # of data
    expert: str = ""  # `module:function`, for those of Gymnasium
    wrappers: tuple[str, ...] = ()
    disturbed: float = 0.0  # share of the episodes with bursts of random actions, for those of Gymnasium
    lookback: int | None = None  # where attention by phase spikes begins
    longer: tuple[int, ...] = ()  # further contexts in which the trained policies play
    settings: "Settings | None" = None  # those of the paper
    dataset: str = ""  # recorded before, in the folder of sets

    @property
    def is_gymnasium(self):
        return bool(self.expert or self.dataset)


TASKS = {
    "cartpole": Task(
        "PositionOnlyCartPole-v1",
        ("--context=10", "--clip_steps=8", "--batch=32", "--iterations=300"),
        rate="2e-3",
        chance=22.6,
        expert_return=500.0,
        data=("--expert_fraction=0.3", "--disturbed_fraction=0.7"),
        longer=(20, 50),
    ),
    "pendulum": Task(
        "PositionOnlyPendulum-v1",
        ("--context=5", "--clip_steps=12", "--batch=24", "--merge=concat", "--iterations=1200"),
        rate="3e-3",
        chance=-1217.3,
        expert_return=-143.6,
        data=("--expert=robust", "--expert_fraction=0", "--disturbed_fraction=1", "--wide_start_fraction=0.25"),
        longer=(10, 25),
    ),
    "repeat-4": Task(
        "popgym:popgym-RepeatPreviousEasy-v0",
        ("--layers=1", "--context=4", "--clip_steps=51", "--batch=8", "--iterations=600"),
        rate="3e-3",
        chance=-0.5,
        expert_return=1.0,
        expert="memory_experts:repeat_previous",
    ),
    "repeat-32": Task(
        "popgym:popgym-RepeatPreviousMedium-v0",
        ("--layers=1", "--heads=8", "--ffn_size=128", "--context=32", "--clip_steps=103", "--batch=4", "--iterations=400"),
        rate="3e-3",
        chance=-0.5,
        expert_return=1.0,
        expert="memory_experts:repeat_previous",
        lookback=31,
    ),
    "memory": Task(
        "minigrid:MiniGrid-MemoryS11-v0",
        ("--context=16", "--clip_steps=16", "--batch=24", "--merge=concat", "--iterations=800"),
        rate="3e-3",
        chance=0.20,
        expert_return=0.98,
        expert="memory_experts:find_match",
        wrappers=WRAPPERS_OF_MEMORY,
        disturbed=0.5,
    ),
}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Values of the optimiser that the paper prints. An epoch draws as many steps as are trained on."""

    rate: str
    batch: int  # clips
    steps: int  # of a clip, and of the context
    epochs: int

    @property
    def epoch(self):
        """Returns the iterations of an epoch. A tenth of the data is held out."""
        return round(0.9 * STEPS_OF_THE_PAPER / (self.batch * self.steps))

    @property
    def flags(self):
        iterations = self.epochs * self.epoch
        validations = f"--validate_every={EPOCHS_BETWEEN_VALIDATIONS * self.epoch}"
        sizes = (f"--context={self.steps}", f"--batch={self.batch}", f"--iterations={iterations}", validations)
        return (*sizes, "--hidden_size=128", "--ticks=10", "--slope=10", *OPTIMISER_OF_THE_PAPER)


STEPS_OF_THE_PAPER = 10_000  # of data
OPTIMISER_OF_THE_PAPER = ("--weight_decay=1e-2", "--schedule=constant", "--warmup=0", "--padding=front")
EPOCHS_BETWEEN_VALIDATIONS = 5
# The paper's tables 1 and 5; by its section 5.4 sequences of table 5 have 50 steps, and by 9.3.1 its curves 200 epochs.
SETTINGS = {"table1": Settings("3e-4", 64, 20, 50), "table5": Settings("1e-4", 16, 50, 200)}
PAPER_TASKS = {"acrobot": "Acrobot-v1", "cartpole": "CartPole-v1", "mountaincar": "MountainCar-v0", "pendulum": "Pendulum-v1"}
# The paper's tasks with its settings. Their returns are not scored.
TASKS_OF_SETTINGS = {
    f"{name}-{setting}": Task(
        environment,
        settings.flags,
        rate=settings.rate,
        chance=math.nan,
        expert_return=math.nan,
        data=("--expert_fraction=0.5",),
        steps=STEPS_OF_THE_PAPER,
        settings=settings,
    )
    for setting, settings in SETTINGS.items()
    for name, environment in PAPER_TASKS.items()
}

# D4RL's three sets of its three tasks, and its returns of random actions and an expert. A policy is asked for the best return of
# the data.
REFERENCES = {
    "hopper": ("Hopper-v5", -20.27, 3234.3),
    "half-cheetah": ("HalfCheetah-v5", -280.18, 12135.0),
    "walker2d": ("Walker2d-v5", 1.63, 4592.3),
}
SETS = ("medium", "medium-replay", "medium-expert")
FIELD_TASKS = {
    f"{name}-{kind}": Task(
        environment,
        ("--context=5", "--clip_steps=5", "--batch=64", "--ticks=4", "--iterations=2000"),
        rate="3e-3",
        chance=chance,
        expert_return=expert_return,
        steps=100_000,
        dataset=f"{name}-{kind}-v0",
    )
    for name, (environment, chance, expert_return) in REFERENCES.items()
    for kind in SETS
}
FIELD_SEEDS, FIELD_RATE_OF_DENSE = 3, "1e-3"


@dataclasses.dataclass(frozen=True)
class Clone:
    """A model without attention that imitates: a perceptron on one observation, or a gated recurrent unit."""

    hidden: int  # of both layers, or of the state
    recurrent: bool = False
    best: float = 1.0  # share of the episodes, by their returns

    @property
    def flags(self):
        return (f"--hidden={self.hidden}", *(["--recurrent"] if self.recurrent else []), f"--best={self.best:g}")


CLONES = {"cloning": Clone(256), "cloning-10": Clone(256, best=0.1), "recurrent": Clone(64, recurrent=True)}
FIELD_ARMS = ("dense", "baseline", "full", "quiet", *CLONES)


@dataclasses.dataclass(frozen=True)
class Arm:
    """What a run has of its own. Another length of the clips keeps the steps of a batch."""

    mode: str = "full"
    flags: tuple[str, ...] = ()
    clip: int | None = None  # steps
    share: float = 1.0  # of the task's iterations
    priced: bool = False  # also in integers


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
ARMS_OF_TRAINING = ARMS | PARTS | QUIET


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a run may cost besides its training."""

    steps: int | None = None  # of data; None: those of the task
    starts: int = 100  # that a policy plays
    priced_starts: int = 5  # that its integer form plays, for the energy
    epochs: float = 20  # of a model without attention
    further: tuple[str, ...] = ()  # flags of `spiketrain train`, after those of the task


SMOKE = Budget(
    steps=300,
    starts=2,
    priced_starts=1,
    epochs=0.1,
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
        """Returns `cartpole-full-3`; also the name of its file and its folder."""
        return "-".join([self.task, self.arm, *([f"rate{self.rate}"] if self.rate else []), str(self.seed)])

    @property
    def plan(self):
        """Returns its task's plan."""
        return (TASKS | TASKS_OF_SETTINGS | FIELD_TASKS)[self.task]

    @property
    def first_start(self):
        return FIRST_SELECTION_SEED if self.rate else FIRST_UNSEEN_SEED


def sweep_runs(tasks):
    """Returns the runs that choose the learning rate of `dense`."""
    return [Run(task, "dense", seed, rate) for seed in SWEEP_SEEDS for task in tasks for rate in RATES]


def study_runs(tasks, seeds):
    """Returns the runs of the study: all of a seed before the next, so that a study that has not ended is balanced."""
    return [Run(task, arm, seed) for seed in range(1, seeds + 1) for task in tasks for arm in ARMS]


def part_runs(tasks, seeds):
    """Returns the runs of the parts, in the same order."""
    return [Run(task, arm, seed) for seed in range(1, seeds + 1) for task in tasks if task in PART_TASKS for arm in PARTS]


def settings_runs():
    """Returns the runs with the paper's settings, all of a setting before the next. They have one seed, as the paper's."""
    return [Run(task, mode, 1) for task in TASKS_OF_SETTINGS for mode in MODES]


def field_runs():
    """Returns the runs on the sets of the field, all of a seed before the next."""
    return [Run(task, arm, seed) for seed in range(1, FIELD_SEEDS + 1) for task in FIELD_TASKS for arm in FIELD_ARMS]


def train_flags(run, rate, budget):
    """Returns the flags of `spiketrain train` for a run, without data and folder. `rate` is the learning rate."""
    if run.arm in CLONES:
        return [f"--seed={run.seed}", *CLONES[run.arm].flags]
    task, arm = run.plan, ARMS_OF_TRAINING[run.arm]
    flags = [f"--mode={arm.mode}", f"--seed={run.seed}", *COMMON, *task.flags, f"--learning_rate={rate}"]
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


def without_repetition(flags):
    """Returns the flags, of which the last with a name counts."""
    return list({flag.partition("=")[0]: flag for flag in flags}.values())
