"""Shipped policies of `spikeserve imitate` play the environments of other packages on a real server."""

import numpy as np
import pytest
import spikeserve

UNSEEN = 2_000_000  # the first seed of the recorded evaluations


def evaluate(address, name, environment, episodes, **options):
    return spikeserve.evaluate(
        environment, name, server=address, episodes=episodes, seed=UNSEEN, **options
    )


def test_lunar_lander(address):
    played = evaluate(address, "lunar-lander", "LunarLander-v3", 10)
    assert np.median(played.returns) > 230
    assert played.spikes_per_decision < 1000


def test_hopper(address, tmp_path, monkeypatch):
    """The expert returns 2990 on 300 starts, random actions 16."""
    pytest.importorskip("mujoco", reason="gymnasium[mujoco] is not installed: its packages are 30 MB")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to MUJOCO_LOG.TXT
    played = evaluate(address, "hopper", "Hopper-v5", 5)
    assert np.median(played.returns) > 2000
    assert played.spikes_per_decision < 1000


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_minigrid_memory(address):
    from minigrid.wrappers import ImgObsWrapper, OneHotPartialObsWrapper

    wrappers = [OneHotPartialObsWrapper, ImgObsWrapper]
    played = evaluate(address, "minigrid-memory", "minigrid:MiniGrid-MemoryS11-v0", 20, wrappers=wrappers)
    assert np.mean(played.returns > 0) >= 0.95  # a wrong choice returns 0


def test_a_policy_that_knows_its_delay(address):
    """The usual policy for Pendulum falls below -600 with a delay of four steps."""
    for steps in (0, 4):
        played = evaluate(address, "pendulum-delay", "Pendulum-v1", 5, delay=steps)
        assert np.median(played.returns) > -450
