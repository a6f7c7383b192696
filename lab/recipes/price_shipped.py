"""Plays the shipped policies on their unseen starts again, and writes returns, spikes and energies into their files.

    python lab/recipes/price_shipped.py [NAME/VERSION ...]

Returns, spikes and energy of a file are then those of the same decisions. Starts and their number are those that the file
records. Needs what docs/guides/imitation.md installs, and the engine of the Python client.
"""

import json
import pathlib
import sys

import numpy as np
from safetensors import safe_open
from spikeserve.engine import Engine
from spikeserve.imitation.environments import EnvironmentFactory, load_object
from spikeserve.imitation.policy_record import write_with_record

POLICIES = pathlib.Path(__file__).parents[2] / "deploy/policies"
WRAPPERS = ["minigrid.wrappers:OneHotPartialObsWrapper", "minigrid.wrappers:ImgObsWrapper"]
# Tasks that Gymnasium alone does not make: id, wrappers.
TASKS = {
    "LatePendulum-v0": ("late:LatePendulum-v0", []),
    "MiniGrid-MemoryS11-v0-OneHotPartialObsWrapper-ImgObsWrapper": ("minigrid:MiniGrid-MemoryS11-v0", WRAPPERS),
}
MODELS = {"int_45nm": "int_energy_joules", "int_sram_45nm": "int_sram_energy_joules", "horowitz_45nm": "energy_joules"}


def play(engine, environment, seed):
    """Returns the return of an episode and the statistics of its decisions."""
    session = engine.session()
    observation, _ = environment.reset(seed=seed)
    total, reward, stats, over = 0.0, 0.0, [], False
    while not over:
        decision = session.act(observation, reward)
        stats.append(decision.stats)
        observation, reward, terminated, truncated, _ = environment.step(decision.action)
        total, over = total + reward, terminated or truncated
    return total, stats


def evaluate(path):
    """Returns the evaluation of a policy file, on the starts of the one that it holds."""
    with safe_open(path, framework="np") as file:
        metadata = file.metadata()
    before = json.loads(metadata["training"])["evaluation"]
    id, wrappers = TASKS.get(metadata["environment"], (metadata["environment"], []))
    environment = EnvironmentFactory(id, [load_object(wrapper, "WRAPPERS") for wrapper in wrappers]).make()
    engine = Engine(path)
    returns, decisions, spikes, joules = [], 0, 0, dict.fromkeys(MODELS, 0.0)
    for seed in range(before["first_seed"], before["first_seed"] + before["episodes"]):
        total, stats = play(engine, environment, seed)
        returns.append(total)
        decisions += len(stats)
        spikes += sum(each.spikes for each in stats)
        for model, field in MODELS.items():
            joules[model] += sum(getattr(each, field) for each in stats)
    return {
        "environment": metadata["environment"],
        "mean_return": float(np.mean(returns)),
        "std_return": float(np.std(returns)),
        "episodes": len(returns),
        "first_seed": before["first_seed"],
        "decisions": decisions,
        "spikes_per_decision": spikes / decisions,
        "estimated_energy_joules_per_decision": {model: total / decisions for model, total in joules.items()},
    }


def main():
    names = sys.argv[1:] or sorted(str(path.parent.relative_to(POLICIES)) for path in POLICIES.glob("*/*/*.safetensors"))
    for name in names:
        path = POLICIES / name / "policy.safetensors"
        evaluation = evaluate(path)
        write_with_record(path, path, {"evaluation": evaluation})
        print(name, json.dumps(evaluation), flush=True)


if __name__ == "__main__":
    main()
