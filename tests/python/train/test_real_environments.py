"""Shipped policies of `spikeserve imitate` play the environments of other packages on a real server."""

import numpy as np
import pytest
import spikeserve

UNSEEN = 2_000_000  # the first seed of the recorded evaluations


def evaluate(address, name, environment, episodes, version, **options):
    return spikeserve.evaluate(
        environment, name, server=address, episodes=episodes, seed=UNSEEN, version=version, **options
    )


@pytest.mark.parametrize("version", [1, 2, 3])
def test_lunar_lander(address, version):
    played = evaluate(address, "lunar-lander", "LunarLander-v3", 10, version)
    assert np.median(played.returns) > 230
    assert played.spikes_per_decision < 1000


@pytest.mark.parametrize("version", [1, 2, 3])
def test_double_pendulum(address, version):
    pytest.importorskip("mujoco", reason="gymnasium[mujoco] is not installed: its packages are 30 MB")
    played = evaluate(address, "double-pendulum", "InvertedDoublePendulum-v5", 2, version)
    assert played.mean_return > 9300


@pytest.mark.parametrize(
    ("name", "environment"),
    [("hopper", "Hopper-v5"), ("half-cheetah", "HalfCheetah-v5"), ("walker2d", "Walker2d-v5")],
)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_robots_that_run(address, name, environment, version, tmp_path, monkeypatch):
    """The experts return 2990, 3203 and 4696 on 300 starts, random actions 16, -261 and 2."""
    pytest.importorskip("mujoco", reason="gymnasium[mujoco] is not installed: its packages are 30 MB")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to MUJOCO_LOG.TXT
    played = evaluate(address, name, environment, 5, version)
    assert np.median(played.returns) > 2000
    assert played.spikes_per_decision < 1000


@pytest.mark.parametrize("size", ["Easy", "Medium", "Hard"])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_repeat_first(address, size, version):
    """One policy remembers the first card for 51, 415 and 831 steps."""
    played = evaluate(address, "repeat-first", f"popgym:popgym-RepeatFirst{size}-v0", 3, version)
    assert played.returns == pytest.approx(1.0)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("version", [1, 2, 3])
def test_minigrid_memory(address, version):
    from minigrid.wrappers import ImgObsWrapper, OneHotPartialObsWrapper

    wrappers = [OneHotPartialObsWrapper, ImgObsWrapper]
    played = evaluate(address, "minigrid-memory", "minigrid:MiniGrid-MemoryS11-v0", 20, version, wrappers=wrappers)
    assert np.mean(played.returns > 0) >= 0.95  # a wrong choice returns 0


@pytest.mark.parametrize(
    ("name", "size", "episodes"),
    [("repeat-previous", "Easy", 20), ("repeat-previous-medium", "Medium", 5), ("repeat-previous-hard", "Hard", 5)],
)
@pytest.mark.parametrize("version", [1, 2, 3])
def test_repeat_previous(address, name, size, episodes, version):
    """What was observed 3, 31 and 63 steps ago decides."""
    played = evaluate(address, name, f"popgym:popgym-RepeatPrevious{size}-v0", episodes, version)
    assert played.mean_return > 0.9


@pytest.mark.parametrize("version", [1, 2, 3])
def test_autoencode(address, version):
    """52 cards in reverse order: what was observed 0, 2, 4, ... 102 steps ago decides. Random actions return -0.5."""
    played = evaluate(address, "autoencode", "popgym:popgym-AutoencodeEasy-v0", 5, version)
    assert played.mean_return > 0.9


@pytest.mark.parametrize("version", [1, 2, 3])
def test_policies_that_know_their_delay(address, version):
    """The usual policies for CartPole and Pendulum fall below 130 and -600 with a delay of four beats."""
    for beats in (0, 4):
        played = evaluate(address, "cartpole-delay", "CartPole-v1", 2, version, delay=beats)
        assert played.mean_return == 500
        played = evaluate(address, "pendulum-delay", "Pendulum-v1", 5, version, delay=beats)
        assert np.median(played.returns) > -450
        played = evaluate(address, "lunar-lander-delay", "LunarLanderContinuous-v3", 5, version, delay=beats)
        assert np.median(played.returns) > 200
