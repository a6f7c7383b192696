"""Adds a version in integer arithmetic to a policy that `spikeserve imitate` made: version 3.

    python lab/recipes/integer_version.py LunarLander-v3 --out=FOLDER --spiketrain=PROGRAM [--flags=--mode=baseline]

FOLDER is that of the run. A dense policy is not pruned. --train=FLAGS trains it through the integers instead, on the
expert's data and from version 1. The float32 version plays from seed 1,500,000 on, which neither training nor evaluation
uses; these episodes are the calibration set of `spiketrain quantize --to=integer --prune`. Then version 3 plays the unseen
starts that version 1 played, and the file records the comparison. Needs what docs/guides/imitation.md installs.
"""

import argparse
import json
import pathlib
import shlex
import subprocess

import numpy as np
from spikeserve.engine import Engine
from spikeserve.imitation.actors import StudentActor
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory, load_object
from spikeserve.imitation.episodes import play
from spikeserve.imitation.figures import Evaluator, Figures
from spikeserve.imitation.policy_record import write_with_record
from spikeserve.imitation.training import find_spiketrain

# As of the episodes that spiketrain plays itself.
CALIBRATION_SEED, CALIBRATION_EPISODES = 1_500_000, 200
ENVIRONMENTS = 16  # played at once
NORMAL_95 = 1.959964


def record_calibration(factory, policy, count, folder):
    """Writes `count` calibration episodes as a dataset of Minari."""
    seeds = iter(range(CALIBRATION_SEED, CALIBRATION_SEED + count))
    episodes = play(factory.make, StudentActor(Engine(policy)), seeds, ENVIRONMENTS)
    environment = factory.make()
    write_dataset(
        folder,
        sorted(episodes, key=lambda episode: episode.seed),
        environment,
        factory.name,
    )
    environment.close()


def paired_returns(environment, first, second):
    """Compares the figures of two versions on equal starts, in the words of `spiketrain quantize`."""
    differences = np.subtract(second.returns, first.returns)
    margin = NORMAL_95 * differences.std(ddof=1) / np.sqrt(len(differences)) if len(differences) > 1 else 0.0
    return {
        "environment": environment,
        "episodes": len(differences),
        "first_seed": first.first_seed,
        "mean_returns": [first.mean, second.mean],
        "mean_difference": differences.mean(),
        "difference_95_percent": [
            differences.mean() - margin,
            differences.mean() + margin,
        ],
        "spikes_per_decision": [first.spikes_per_decision, second.spikes_per_decision],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id", help="as `spikeserve imitate` takes it")
    parser.add_argument(
        "--wrapper",
        action="append",
        default=[],
        help="module:class of a wrapper; may be repeated",
    )
    parser.add_argument(
        "--out",
        required=True,
        type=pathlib.Path,
        help="folder of the run of `spikeserve imitate`",
    )
    parser.add_argument("--spiketrain", help="the program; default: $SPIKETRAIN, or the one on PATH")
    parser.add_argument(
        "--flags",
        default="",
        help="further flags of `spiketrain quantize`, in one string",
    )
    parser.add_argument("--calibration", type=int, default=CALIBRATION_EPISODES, help="episodes of the calibration set")
    parser.add_argument("--train", help="flags of `spiketrain train`, in one string; default: version 1 is only rounded")
    arguments = parser.parse_args()
    factory = EnvironmentFactory(arguments.env_id, [load_object(path, "--wrapper") for path in arguments.wrapper])
    out = arguments.out.resolve()
    versions = pathlib.Path("policies", factory.policy_name)
    first, third = (versions / version / "policy.safetensors" for version in "13")
    stage = pathlib.Path("stages/integer/policy.safetensors")
    # Paths are relative, so that the record does not depend on the machine.
    if arguments.train is not None:
        command = ["train", "--arithmetic=integer", "--allow_loss", "--no_baselines", *shlex.split(arguments.train)]
        command += [f"--init={first}", "--data=data/expert-v0", f"--out={stage.parent}"]
    else:
        data = pathlib.Path("data/calibration-v0")
        if not (out / data).is_dir():
            record_calibration(factory, out / first, arguments.calibration, out / data)
        # Only spikes show which hidden neurons are idle.
        dense = json.loads((out / "settings.json").read_text())["mode"] == "dense"
        command = ["quantize", "--max_loss=1", "--to=integer", *([] if dense else ["--prune"]), *shlex.split(arguments.flags)]
        command += [f"--policy={first}", f"--data={data}", f"--out={stage}"]
    if not (out / stage).is_file():  # a recipe that was interrupted continues
        subprocess.run([find_spiketrain(arguments.spiketrain), *command], cwd=out, check=True)
    before = Figures.from_json(json.loads((out / "evaluations/version-1.json").read_text()))
    evaluator = Evaluator(factory, ENVIRONMENTS)
    after = evaluator.evaluate_policy(out / stage, before.first_seed, len(before.returns), "version 3 plays unseen starts")
    evaluation = after.to_json()
    del evaluation["returns"]
    comparison = paired_returns(factory.name, before, after)
    write_with_record(
        out / stage,
        out / third,
        {"paired_returns": comparison, "evaluation": evaluation},
    )
    print(json.dumps(comparison, indent=2))


if __name__ == "__main__":
    main()
