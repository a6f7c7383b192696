"""Two-minute forms of `python -m spikeserve imitate`: from an environment and an expert to a served policy."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import safetensors
import spikeserve
from serving import running_server
from test_imitation_plans import walk

TINY = "--environments=8 --hidden-size=32 --selection-episodes=16 --episodes=40".split()


def imitate(out, env_id, expert, *flags):
    """Runs the command. Returns the metadata of the run."""
    command = [sys.executable, "-m", "spikeserve", "imitate", env_id, f"--expert={expert}", f"--out={out}"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([*command, *TINY, *flags], check=True, env=environment)
    return json.loads((out / "metadata.json").read_text())


def mean_return_of(figures, title):
    (match,) = [value for name, value in figures.items() if name.startswith(title)]
    return match["mean_return"]


def served_return(out, env_id, name, episodes):
    """Plays the same starts as the final evaluation on a real server, with the policy of version 2."""
    with running_server(out / "policies") as addresses:
        played = spikeserve.evaluate(env_id, name, server=addresses.grpc, episodes=episodes, seed=2_000_000)
    assert played.version == 2
    return played.mean_return


def test_cartpole(tmp_path):
    flags = ["--steps=12000", "--iterations=250", "--rounds=1", "--round-steps=4000", "--round-iterations=120"]
    silence = ["--silence=3:15,1.5:9", "--silence-iterations=100"]
    metadata = imitate(tmp_path, "CartPole-v1", "home_made:balance", *flags, *silence)
    figures = metadata["figures"]
    assert mean_return_of(figures, "expert") == 500
    assert mean_return_of(figures, "cartpole/1") > 450
    assert served_return(tmp_path, "CartPole-v1", "cartpole", 40) == mean_return_of(figures, "cartpole/2")
    loud = metadata["stages"]["2-round1"]["spikes_per_decision"]
    assert metadata["stages"]["3-silence-3"]["spikes_per_decision"] < loud / 2


def test_an_environment_with_dict_observations_and_multidiscrete_actions(tmp_path):
    flags = ["--steps=12000", "--iterations=300", "--rounds=1", "--round-steps=4000", "--round-iterations=100"]
    silence = ["--silence=3:15", "--silence-iterations=100"]
    figures = imitate(tmp_path, "home_made:HomeMade-v0", "home_made:go_to_corner", *flags, *silence)["figures"]
    chance = json.loads((tmp_path / "evaluations/chance.json").read_text())["mean_return"]
    expert = mean_return_of(figures, "expert")
    policy = mean_return_of(figures, "homemade/1")
    assert policy > expert - 0.1 * (expert - chance)
    served = served_return(tmp_path, "home_made:HomeMade-v0", "homemade", 40)
    assert served == pytest.approx(mean_return_of(figures, "homemade/2"), abs=1e-9)


def test_an_environment_with_small_images(tmp_path):
    """The images are embedded in patches that share their weights; the policy file holds the product."""
    flags = ["--steps=12000", "--iterations=400", "--rounds=1", "--round-steps=4000", "--round-iterations=150"]
    silence = ["--silence=3:15", "--silence-iterations=100"]
    figures = imitate(tmp_path, "home_made:Picture-v0", "home_made:go_to_dot", *flags, *silence)["figures"]
    with safetensors.safe_open(tmp_path / "stages/1-play/policy.safetensors", framework="np") as file:
        weight, mean = file.get_tensor("embed.state.weight"), file.get_tensor("observation.mean")
        assert "--image_shape=16,16,3 --patch_size=4" in json.loads(file.metadata()["training"])["command"]
    assert weight.shape == (32, 16 * 16 * 3)
    patches = weight.reshape(32, 4, 4, 4, 4, 3).transpose(0, 1, 3, 2, 4, 5).reshape(32 * 16, 48)
    assert np.linalg.matrix_rank(patches, tol=1e-4) == 8, "8 features describe every patch"
    assert len(set(mean.tolist())) <= 3, "the pixels of a channel are standardised alike"
    chance = json.loads((tmp_path / "evaluations/chance.json").read_text())["mean_return"]
    expert = mean_return_of(figures, "expert")
    assert mean_return_of(figures, "picture/1") > expert - 0.2 * (expert - chance)
    served = served_return(tmp_path, "home_made:Picture-v0", "picture", 40)
    assert served == pytest.approx(mean_return_of(figures, "picture/2"), abs=1e-9)


@pytest.mark.parametrize(("mode", "least"), [("dense", -16), ("full", -18)])
def test_a_reacher_with_hidden_velocity(tmp_path, mode, least):
    """As docs/guides prints it. The expert returns -13, random actions -710, a policy without observed changes -94."""
    _, mean_return = walk(tmp_path, f"--mode={mode}")
    assert mean_return >= least
    metadata = json.loads((tmp_path / "reacher2d/metadata.json").read_text())
    versions = ["reacher2d/1"] if mode == "dense" else ["reacher2d/1", "reacher2d/2"]
    for version in versions:
        assert mean_return_of(metadata["figures"], version) >= least
    if mode == "dense":
        return
    with running_server(tmp_path / "reacher2d/policies") as addresses:
        played = spikeserve.evaluate(
            "hidden_state:Reacher2D-v0", "reacher2d", server=addresses.grpc, episodes=40, seed=2_000_000
        )
    assert (played.version, played.mean_return >= least) == (2, True), played
