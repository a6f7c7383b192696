"""A line on a queue of past observations plays RepeatPrevious, if the queue is long enough."""

import re
import sys

import pytest
from documentation import DOCS
from spikeserve.imitation.actors import ExpertActor
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import play
from spikeserve.imitation.experts import load_expert

sys.path.insert(0, str(DOCS.parent / "train/recipes"))
import memory_experts  # noqa: E402
import queue_baselines  # noqa: E402

ENVIRONMENT = "popgym:popgym-RepeatPreviousEasy-v0"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Records the expert. Returns the folder."""
    factory = EnvironmentFactory(ENVIRONMENT)
    expert = ExpertActor(load_expert(memory_experts.repeat_previous))
    folder = tmp_path_factory.mktemp("data") / "expert-v0"
    environment = factory.make()
    write_dataset(folder, list(play(factory.make, expert, iter(range(100)), 16)), environment, factory.name)
    environment.close()
    return folder


@pytest.mark.parametrize(("length", "hidden", "least", "most"), [(4, 0, 0.99, 1), (3, 0, -1, 0), (4, 16, 0.9, 1)])
def test_the_queue_has_to_hold_what_is_asked_for(recorded, monkeypatch, capsys, length, hidden, least, most):
    flags = [f"--data={recorded}", f"--length={length}", f"--hidden={hidden}", "--episodes=10", "--epochs=40"]
    monkeypatch.setattr(sys, "argv", ["queue_baselines.py", ENVIRONMENT, *flags])
    queue_baselines.main()
    printed = capsys.readouterr().out
    found = re.fullmatch(rf"hidden {hidden}: return (\S+) ± \S+, (\d+) multiplications, \S+ of the labels\n", printed)
    assert least <= float(found[1]) <= most
    assert int(found[2]) == (16 * length if hidden == 0 else 64 * length + 256 + 64)
