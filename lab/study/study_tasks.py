"""The tasks of the study, and how a model learns each of them."""

import dataclasses
import math

WRAPPERS_OF_MEMORY = ("minigrid.wrappers:OneHotPartialObsWrapper", "minigrid.wrappers:ImgObsWrapper")


@dataclasses.dataclass(frozen=True)
class Cloning:
    """How models without attention learn a task."""

    queue: int = 1  # newest observations, side by side, that a line or a perceptron reads
    epochs: int = 20  # of lines and perceptrons
    clip: int = 50  # steps of an episode from which a recurrent unit learns at once
    recurrent_epochs: int = 20
    standardised: bool = True  # inputs have mean 0 and deviation 1

    @property
    def flags(self):
        """Returns what differs from the defaults."""
        values = ((field, getattr(self, field.name)) for field in dataclasses.fields(self))
        return tuple(f"--{field.name}={value}" for field, value in values if value != field.default)


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
    bursts: tuple[float, int] = (0.1, 2)  # their largest rate, and most steps
    lookback: int | None = None  # where attention by phase spikes begins
    longer: tuple[int, ...] = ()  # further contexts in which the trained policies play
    settings: "Settings | None" = None  # those of the paper
    dataset: str = ""  # recorded before, in the folder of sets
    rate_of_dense: str = ""  # empty: the best of the sweep
    spiking: tuple[str, ...] = ()  # further flags of spiking arms
    cloning: Cloning = Cloning()

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
        rate_of_dense=settings.rate,
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
        rate_of_dense="1e-3",
        chance=chance,
        expert_return=expert_return,
        steps=100_000,
        dataset=f"{name}-{kind}-v0",
    )
    for name, (environment, chance, expert_return) in REFERENCES.items()
    for kind in SETS
}

# Tasks that a queue and a small network should not play. All spiking arms have four ticks.
FOUR_TICKS = "--ticks=4"
STRUCTURED_TASKS = {
    "recall": Task(
        "recall:Recall-v0",
        ("--layers=1", "--context=16", "--clip_steps=16", "--batch=32", "--heads=4", "--ffn_size=128", "--iterations=1500"),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=-0.5,
        expert_return=1.0,
        steps=60_000,
        expert="recall:recall",
        spiking=(FOUR_TICKS,),
        cloning=Cloning(queue=16, recurrent_epochs=60, standardised=False),
    ),
    "recall-32": Task(
        "recall:Recall32-v0",
        (
            *("--layers=1", "--hidden_size=128", "--context=64", "--clip_steps=64", "--batch=16", "--heads=4", "--ffn_size=128"),
            "--iterations=1500",
        ),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=-0.5,
        expert_return=1.0,
        steps=60_000,
        expert="recall:recall",
        spiking=(FOUR_TICKS,),
        cloning=Cloning(queue=64, epochs=10, clip=64, recurrent_epochs=60, standardised=False),
    ),
    "repeat-64": Task(
        "popgym:popgym-RepeatPreviousHard-v0",
        ("--layers=1", "--context=64", "--clip_steps=155", "--batch=4", "--heads=8", "--ffn_size=128", "--iterations=1500"),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=-0.5,
        expert_return=1.0,
        steps=40_000,
        expert="memory_experts:repeat_previous",
        spiking=(FOUR_TICKS, "--relative_bias=true"),
        cloning=Cloning(queue=64, clip=155, recurrent_epochs=60, standardised=False),
    ),
    "autoencode": Task(
        "popgym:popgym-AutoencodeEasy-v0",
        (
            *("--layers=1", "--hidden_size=128", "--context=103", "--clip_steps=103", "--batch=8", "--heads=8", "--ffn_size=128"),
            "--iterations=2000",
        ),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=-0.517,
        expert_return=1.0,
        steps=60_000,
        expert="memory_experts:autoencode",
        spiking=("--mode=pos", "--mirror=51", "--ticks=2"),
        cloning=Cloning(queue=103, clip=103, recurrent_epochs=100, standardised=False),
    ),
    "count-recall": Task(
        "popgym:popgym-CountRecallEasy-v0",
        ("--context=52", "--clip_steps=51", "--batch=8", "--iterations=2000"),
        rate="3e-3",
        chance=-0.931,
        expert_return=1.0,
        steps=60_000,
        expert="memory_experts:count_recall",
        disturbed=0.5,
        spiking=(FOUR_TICKS,),
        cloning=Cloning(queue=52, clip=51, recurrent_epochs=60, standardised=False),
    ),
    "concentration": Task(
        "popgym:popgym-ConcentrationEasy-v0",
        (
            *("--layers=1", "--hidden_size=128", "--context=104", "--clip_steps=104", "--batch=16", "--heads=8"),
            *("--ffn_size=256", "--iterations=1500"),
        ),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=-0.187,
        expert_return=0.812,
        steps=240_000,
        expert="memory_experts:concentration",
        disturbed=0.5,
        spiking=(FOUR_TICKS, "--relative_bias=true"),
        cloning=Cloning(queue=32, epochs=5, clip=104, standardised=False),
    ),
    "hidden-cartpole": Task(
        "hidden_physics:HiddenCartPole-v0",
        ("--context=16", "--clip_steps=32", "--batch=32", "--heads=4", "--ffn_size=128", "--iterations=2000"),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=28.1,
        expert_return=500.0,
        steps=240_000,
        expert="hidden_physics:balance",
        disturbed=0.8,
        bursts=(0.3, 8),
        spiking=(FOUR_TICKS,),
        cloning=Cloning(queue=8, epochs=10),
    ),
    "many-tasks": Task(
        "many_tasks:ManyTasks-v0",
        ("--context=4", "--clip_steps=8", "--batch=96", "--heads=4", "--ffn_size=128", "--iterations=1000"),
        rate="3e-3",
        rate_of_dense="3e-3",
        chance=0.0,
        expert_return=1.0,
        steps=60_000,
        expert="many_tasks:play",
        disturbed=0.8,
        bursts=(0.3, 8),
        spiking=(FOUR_TICKS,),
        cloning=Cloning(queue=2),
    ),
    "memory-13": Task(
        "minigrid:MiniGrid-MemoryS13-v0",
        ("--context=20", "--clip_steps=20", "--batch=20", "--merge=concat", "--iterations=1000"),
        rate="3e-3",
        chance=0.25,
        expert_return=0.986,
        steps=40_000,
        expert="memory_experts:find_match",
        wrappers=WRAPPERS_OF_MEMORY,
        disturbed=0.5,
        spiking=(FOUR_TICKS,),
        cloning=Cloning(queue=20, epochs=5, standardised=False),
    ),
}

# The paper's tasks at the size of the study, and what its integers lose. One rate suits `dense`: no arm is ranked here.
_SHORT = ("--context=10", "--clip_steps=5", "--batch=64")
TASKS_OF_THE_PAPER = {
    "CartPole-v1": Task(
        "CartPole-v1",
        (*_SHORT, "--iterations=300"),
        rate="2e-3",
        rate_of_dense="1e-3",
        chance=21.5,
        expert_return=500.0,
        data=("--expert_fraction=0.5", "--disturbed_fraction=0.5"),
    ),
    "Acrobot-v1": Task(
        "Acrobot-v1",
        (*_SHORT, "--iterations=400"),
        rate="2e-3",
        rate_of_dense="1e-3",
        chance=-500.0,
        expert_return=-64.1,
        data=("--expert=lookahead", "--weigh", "--expert_fraction=0.1", "--disturbed_fraction=0.9"),
    ),
    "MountainCar-v0": Task(
        "MountainCar-v0",
        (*_SHORT, "--iterations=400"),
        rate="2e-3",
        rate_of_dense="1e-3",
        chance=-200.0,
        expert_return=-98.7,
        data=("--expert_fraction=0.2", "--disturbed_fraction=0.8"),
    ),
    "Pendulum-v1": Task(
        "Pendulum-v1",
        (*_SHORT, "--iterations=800", "--action_noise=0.5"),
        rate="3e-3",
        rate_of_dense="1e-3",
        chance=-1217.3,
        expert_return=-143.6,
        data=("--expert=robust", "--expert_fraction=0", "--disturbed_fraction=1", "--wide_start_fraction=0.25"),
    ),
}

# The tasks by the table of their results.
GROUPS = {"study": TASKS, "paper": TASKS_OF_THE_PAPER, "settings": TASKS_OF_SETTINGS, "field": FIELD_TASKS, "structured": STRUCTURED_TASKS}
ALL_TASKS = {name: task for tasks in GROUPS.values() for name, task in tasks.items()}
