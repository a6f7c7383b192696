"""`imitate`: records, trains, asks the expert again, silences, quantises and evaluates."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from spikeserve.check import check
from spikeserve.engine import Engine
from spikeserve.flat_spaces import FlatEnvironment
from spikeserve.imitation.actors import Bursts, DelayedStudentActor, ExpertActor, StudentActor
from spikeserve.imitation.baselines import (
    LARGEST_COMPARED,
    Baseline,
    BaselineActor,
    Comparison,
    return_warnings,
)
from spikeserve.imitation.datasets import (
    check_packages,
    check_spaces,
    open_dataset,
    read_dataset,
    write_dataset,
)
from spikeserve.imitation.delays import label_all_after
from spikeserve.imitation.environments import EnvironmentFactory, is_found_by_name, name_of
from spikeserve.imitation.episodes import Actor, Budget, Episode, play
from spikeserve.imitation.experts import Expert, is_dataset, load_expert
from spikeserve.imitation.figures import Evaluator, Figures
from spikeserve.imitation.images import image_flags
from spikeserve.imitation.insight import Insight, drift, learning_curves, noise_floor
from spikeserve.imitation.journal import Journal
from spikeserve.imitation.memory import TrainingPlan, plan_training
from spikeserve.imitation.options import FIRST_SELECTION_SEED, FIRST_UNSEEN_SEED, ImitationOptions
from spikeserve.imitation.pace import RecordingPlan, plan_recording
from spikeserve.imitation.policy_record import write_with_record
from spikeserve.imitation.progress import progress_bar
from spikeserve.imitation.report import Account, ImitationResult, has_changes, write_report
from spikeserve.imitation.training import Spiketrain, Training, find_spiketrain
from spikeserve.printing import say

# Every round of data has environment seeds of its own.
_SEEDS_OF_A_ROUND = 50_000
_BASELINE_EPISODES = 100


@dataclass(frozen=True)
class _Candidate:
    """A trained policy with its figures on the starts for selection."""

    name: str
    policy: pathlib.Path
    figures: Figures


def imitate(
    env_id: str,
    expert: str | Callable[..., Any],
    out: str | pathlib.Path,
    *,
    options: ImitationOptions | None = None,
    wrappers: Sequence[Callable[[Any], Any]] = (),
    spiketrain: str | None = None,
    overwrite: bool = False,
) -> ImitationResult:
    """See `spikeserve.imitate`."""
    options = options or ImitationOptions()
    check_packages()
    factory = EnvironmentFactory(env_id, wrappers, options.max_episode_steps)
    # Minari joins a relative folder to itself.
    folder = pathlib.Path(out).resolve()
    trainer = Spiketrain(find_spiketrain(spiketrain), options.threads, folder)
    environment = factory.make()  # refuses an environment that cannot be used
    image_flags(environment.native_space, options.patch_size)  # refuses patches that do not fit
    environment.close()
    source = str(expert) if is_dataset(expert) else load_expert(expert)
    if isinstance(source, str):
        check_spaces(open_dataset(source), environment, source)
    trainer.check_flags(options.train_flags)
    given: list[Any] = [*wrappers, expert]
    unclear = [name_of(each) for each in given if callable(each) and not is_found_by_name(each)]
    check(
        overwrite or not unclear or not (folder / "settings.json").is_file(),
        "out",
        f"another folder, or --overwrite, because no name says which {', '.join(unclear)} it was",
        f"{folder} with a run",
    )
    settings = {
        "environment": factory.name,
        "expert": name_of(expert) if callable(expert) else str(expert),
        "env_id": env_id,
        "wrappers": [name_of(wrapper) for wrapper in wrappers],
        **asdict(options),
    }
    journal = Journal(folder, settings, overwrite)
    return _Run(factory, environment, source, options, trainer, journal).run()


class _Run:
    """One run. Every method skips what an interrupted run has finished."""

    def __init__(
        self,
        factory: EnvironmentFactory,
        environment: FlatEnvironment,
        source: str | Expert,
        options: ImitationOptions,
        trainer: Spiketrain,
        journal: Journal,
    ) -> None:
        self._factory = factory
        self._environment = environment  # closed; it tells the spaces
        self._dataset = source if isinstance(source, str) else None
        self._expert = None if isinstance(source, str) else source
        self._options = options
        self._trainer = trainer
        self._journal = journal
        self._delays = options.delays
        self._evaluator = Evaluator(factory, options.environments, self._delays)
        self._data: list[pathlib.Path] = []
        self._stages: list[_Candidate] = []
        self._recording = RecordingPlan(
            **self._chosen(
                "recording", lambda: plan_recording(options, self._expert, self._evaluator)
            )
        )
        self._training: TrainingPlan

    def run(self) -> ImitationResult:
        """Runs every part and writes policies and report."""
        self._record_expert()
        space = self._environment.actions.space
        self._training = TrainingPlan(
            **self._chosen("training", lambda: plan_training(self._options, self._data[0], space))
        )
        best = self._learn_to_play()
        # A dense policy has no spikes to save, and no integer form.
        return self._publish(best if self._is_dense else self._silence(best))

    @property
    def _is_dense(self) -> bool:
        return self._options.mode == "dense"

    def _chosen(
        self, name: str, choose: Callable[[], RecordingPlan | TrainingPlan]
    ) -> dict[str, Any]:
        """Returns the fields of a plan, and says on standard error why they are so."""
        plan = self._journal.part(f"plans/{name}", lambda: asdict(choose()))
        for reason in plan["reasons"]:
            say(f"chosen: {reason}", error=True)
        return {key: value for key, value in plan.items() if key != "seconds"}

    def _settings(self) -> dict[str, Any]:
        """Returns all settings, with those that were chosen."""
        chosen = asdict(self._recording) | asdict(self._training)
        del chosen["reasons"]
        return asdict(self._options) | chosen

    # Data

    def _bursts(self, disturbed: float) -> Bursts:
        return Bursts(
            self._options.seed,
            disturbed,
            self._recording.burst_rate,
            self._recording.longest_burst,
            self._options.held_bursts,
        )

    def _record_expert(self) -> None:
        if self._expert is None:
            assert self._dataset is not None
            played = read_dataset(self._dataset, self._environment)
            self._write_data("expert", lambda: self._label_after(played))
            return
        actor = ExpertActor(self._expert, self._bursts(self._options.disturbed))
        steps = self._recording.steps
        self._write_data("expert", lambda: self._play_steps(actor, steps, 0, "expert plays"))

    def _record_round(self, number: int, student: pathlib.Path) -> None:
        bursts = self._bursts(self._options.round_disturbed)
        actor = self._student(Engine(student), bursts)
        first_seed = number * _SEEDS_OF_A_ROUND
        title = f"round {number}: policy plays, expert labels"
        self._write_data(
            f"round{number}",
            lambda: self._play_steps(actor, self._recording.round_steps, first_seed, title),
        )

    def _student(self, engine: Engine, bursts: Bursts) -> StudentActor:
        if not self._delays:
            return StudentActor(engine, self._expert, bursts)
        return DelayedStudentActor(engine, self._delay_of, self._expert, bursts)

    def _delay_of(self, episode_seed: int) -> int:
        """Returns the steps of delay of an episode of the data."""
        return self._delays.drawn(self._options.seed, episode_seed)

    def _label_after(self, episodes: Iterable[Episode]) -> list[Episode]:
        """Gives every step the expert's action of the step in which its decision is executed."""
        return label_all_after(episodes, self._delays, self._options.seed)

    def _play_steps(self, actor: Actor, steps: int, first_seed: int, title: str) -> list[Episode]:
        # Runs with other seeds play other starts. All of them are below those of evaluations.
        first_seed += 100_000 * (self._options.seed % 5)
        episodes = []
        with progress_bar(steps, "steps", title) as progress:
            budget = Budget(steps, first_seed, progress)
            for episode in play(self._factory.make, actor, budget, self._options.environments):
                budget.count(episode)
                episodes.append(episode)
        return self._label_after(episodes)

    def _write_data(self, name: str, record: Callable[[], list[Episode]]) -> None:
        folder = self._journal.folder / "data" / f"{name}-v0"
        if not folder.is_dir():
            write_dataset(folder, record(), self._environment, self._factory.name)
        self._data.append(folder)

    # Training

    def _train(
        self, name: str, iterations: int, init: _Candidate | None, flags: Sequence[str] = ()
    ) -> _Candidate:
        options, plan = self._options, self._training
        number = len(self._stages) + 1
        stage = f"{number}-{name}"
        common = [
            f"--clip_steps={plan.clip_steps}",
            f"--batch={options.batch}",
            f"--learning_rate={plan.learning_rate}",
            f"--action_noise={plan.action_noise}",
            *([] if init else self._shape_flags()),
            *flags,
            *options.train_flags,
        ]
        training = Training(
            self._data, options.seed + number, iterations, common, init.policy if init else None
        )
        out = self._journal.folder / "stages" / stage
        self._journal.part(
            f"stages/{stage}", lambda: {"policy": str(self._trainer.train(training, out))}
        )
        policy = out / "policy.safetensors"
        figures = self._journal.figures(
            stage,
            lambda: self._evaluator.evaluate_policy(
                policy, FIRST_SELECTION_SEED, options.selection_episodes, f"{stage} plays"
            ),
        )
        candidate = _Candidate(stage, policy, figures)
        self._stages.append(candidate)
        return candidate

    def _shape_flags(self) -> list[str]:
        """Returns the flags of `spiketrain train` for a new policy and its images."""
        options = self._options
        names = ("mode", "hidden_size", "layers", "ticks")
        flags = [f"--{name}={getattr(options, name)}" for name in names]
        flags.append(f"--context={self._training.context}")
        for name in ("lookback", "mirror"):
            if (timestep := getattr(options, name)) is not None:
                flags.append(f"--{name}={timestep}")
        return flags + image_flags(self._environment.native_space, options.patch_size)

    def _learn_to_play(self) -> _Candidate:
        """Trains on the expert's data, then on the policy's own states. Returns the best policy."""
        # Every stage has another seed.
        for _ in range(self._options.seeds):
            self._train("play", self._training.iterations, None)
        candidate = max(self._stages, key=lambda stage: stage.figures.mean)
        returns = [candidate.figures.mean]
        rounds = 0 if self._expert is None else self._options.rounds
        for number in range(1, rounds + 1):
            self._record_round(number, candidate.policy)
            candidate = self._train(f"round{number}", self._training.round_iterations, candidate)
            returns.append(candidate.figures.mean)
            if has_stalled(returns, self._options.patience):
                break
        return max(self._stages, key=lambda stage: stage.figures.mean)

    def _silence(self, loud: _Candidate) -> _Candidate:
        """Lowers the firing rates in steps while the return holds. Returns the last such policy."""
        allowed = self._options.tolerance * abs(self._expert_return() - self._chance().mean)
        kept = loud
        for hidden, readout in self._options.silence:
            flags = [f"--target_rate={hidden}", f"--readout_rate={readout}"]
            iterations = self._training.silence_iterations
            step = self._train(f"silence-{hidden:g}", iterations, kept, flags)
            fall, error = step.figures.falls_by(loud.figures)
            if fall - error > allowed:
                break
            kept = step
        return kept

    # Results

    def _chance(self) -> Figures:
        return self._journal.figures(
            "chance",
            lambda: self._evaluator.evaluate_chance(
                FIRST_SELECTION_SEED, self._options.selection_episodes
            ),
        )

    def _expert_return(self) -> float:
        return self._expert_figures(
            FIRST_SELECTION_SEED, self._options.selection_episodes, "expert-selection"
        ).mean

    def _expert_figures(self, first_seed: int, episodes: int, name: str) -> Figures:
        """Returns the expert's figures on given starts, or those of its dataset."""
        expert = self._expert
        if expert is None:
            return self._journal.figures("expert", lambda: Figures.of(read_dataset(self._data[0])))
        return self._journal.figures(
            name,
            lambda: self._evaluator.evaluate(
                ExpertActor(expert), first_seed, episodes, "expert plays"
            ),
        )

    def _publish(self, chosen: _Candidate) -> ImitationResult:
        folder = self._journal.folder
        first_figures = self._play_version(1, chosen.policy)
        first = self._publish_version(1, chosen.policy, first_figures)
        second: pathlib.Path | None = None
        second_figures: Figures | None = None
        lost: list[str] = []
        if not self._is_dense:
            # From the published file, so that its record names a parent that exists for others.
            stage = folder / "stages/quantized/policy.safetensors"
            quantized = self._trainer.quantize(first, self._data, stage)
            second_figures = self._play_version(2, quantized)
            judged = folder / "stages/judged/policy.safetensors"
            lost = self._lost_return(first, judged, first_figures, second_figures)
            if not lost:
                second = self._publish_version(2, judged, second_figures)
        insight, baselines = self._explain(first, first_figures)
        comparison = insight.comparison
        compared = comparison.warnings if comparison else []
        result = ImitationResult(
            baselines=baselines,
            warnings=[*lost, *compared, *return_warnings(first_figures, baselines)],
            policies=folder / "policies",
            policy=first,
            quantized=second,
            report=folder / "report.md",
            figures=first_figures,
            quantized_figures=None if second is None else second_figures,
            expert_figures=self._expert_figures(
                FIRST_UNSEEN_SEED, self._options.episodes, "expert-unseen"
            ),
            errors=comparison.errors if comparison else {},
            verdict=insight.verdict(),
            advice=insight.advice(has_changes(first), self._training.context),
        )
        stages = {stage.name: stage.figures for stage in self._stages}
        name = self._factory.policy_name
        reasons = [*self._recording.reasons, *self._training.reasons]
        settings = json.loads((folder / "settings.json").read_text()) | self._settings()
        write_report(
            result.report,
            Account(self._journal, settings, reasons, name, chosen.name, stages, self._delays),
            result,
            insight,
        )
        return result

    def _play_version(self, version: int, source: pathlib.Path) -> Figures:
        """Evaluates a policy on unseen starts."""
        title = f"version {version} plays unseen starts"
        return self._journal.figures(
            f"version-{version}",
            lambda: self._evaluator.evaluate_policy(
                source, FIRST_UNSEEN_SEED, self._options.episodes, title
            ),
        )

    def _lost_return(
        self, policy: pathlib.Path, judged: pathlib.Path, before: Figures, after: Figures
    ) -> list[str]:
        """Writes the integers and what they lost to `judged`. Returns a warning if too much."""
        returns = {
            "before": before.returns,
            "after": after.returns,
            "random": [self._chance().mean],
        }
        verdict = self._trainer.judge(policy, self._data, judged, returns)
        if verdict["grade"] != "bad":
            return []
        advice = " or ".join(verdict["advice"])
        return [
            f"in integers the policy returns {after.mean:.4g} instead of {before.mean:.4g}: "
            f"{verdict['reason']}, so there is no version 2: try {advice}"
        ]

    def _publish_version(
        self, version: int, source: pathlib.Path, figures: Figures
    ) -> pathlib.Path:
        """Writes a policy with its evaluation as a version that can be served."""
        name = self._factory.policy_name
        folder = self._journal.folder / "policies" / name / str(version)
        evaluation = {key: value for key, value in figures.to_json().items() if key != "returns"}
        settings = {"environment": self._factory.name, **self._settings()}
        target = folder / "policy.safetensors"
        if not target.is_file():  # a second writing would order the metadata differently
            record = {"evaluation": evaluation, "imitation": settings}
            write_with_record(source, target, record)
        return target

    # Reasons

    def _explain(
        self, policy: pathlib.Path, figures: Figures
    ) -> tuple[Insight, dict[str, Figures]]:
        """Returns why the policy is as good as it is, and the returns of the baselines."""
        # With delays a baseline would imitate other labels, and what the policy decides is not for
        # the state in which the expert is asked.
        comparison = None if self._delays else self._compare(policy)
        baselines = {} if comparison is None else self._play_baselines(comparison)
        floor, drifts = None, None
        if (expert := self._expert) is not None:
            seeds = range(FIRST_SELECTION_SEED, FIRST_SELECTION_SEED + self._options.environments)
            asked = self._journal.part(
                "evaluations/noise", lambda: {"floor": noise_floor(self._factory, expert, seeds)}
            )
            floor = asked["floor"]
            if not self._delays:
                student = StudentActor(Engine(policy), expert)
                driven = self._journal.part(
                    "evaluations/drift", lambda: {"bins": drift(self._factory, student, seeds)}
                )
                drifts = [(first, last, error) for first, last, error in driven["bins"]]
        chance = self._chance()
        expert_return = self._expert_figures(
            FIRST_UNSEEN_SEED, self._options.episodes, "expert-unseen"
        ).mean
        plays = [stage for stage in self._stages if stage.name.endswith("-play")]
        curves = learning_curves([stage.policy.parent for stage in plays])
        way = expert_return - chance.mean
        share = (figures.mean - chance.mean) / way if way > 0 else None
        return Insight(comparison, floor, drifts, share, chance, curves), baselines

    def _compare(self, policy: pathlib.Path) -> Comparison | None:
        """Returns None if the observations are too large for baselines."""
        if self._environment.observations.size > LARGEST_COMPARED:
            return None
        out = self._journal.folder / "evaluations/comparison.json"
        return Comparison.read(self._trainer.compare(policy, self._data, out))

    def _play_baselines(self, comparison: Comparison) -> dict[str, Figures]:
        """Plays the first of the unseen starts."""
        episodes = min(self._options.episodes, _BASELINE_EPISODES)

        def play_one(baseline: Baseline) -> Figures:
            actor, title = BaselineActor(baseline), f"{baseline.name} plays"
            return self._journal.figures(
                f"baseline-{baseline.name.replace(' ', '-')}",
                lambda: self._evaluator.evaluate(actor, FIRST_UNSEEN_SEED, episodes, title),
            )

        return {baseline.name: play_one(baseline) for baseline in comparison.baselines}


def has_stalled(returns: Sequence[float], patience: int) -> bool:
    """Returns whether the last `patience` returns are no better than the best before them.

    A patience of 0 never ends.
    """
    return 0 < patience < len(returns) and max(returns[-patience:]) <= max(returns[:-patience])
