"""The options of `spikeserve.imitate`: what is refused before anything is recorded, and what a run must continue with."""

import functools
import json
import os
import sys
import types

import gymnasium
import home_made
import numpy as np
import pytest
import spikeserve
from gymnasium import spaces
from serving import run
from spikeserve.imitation import pipeline
from spikeserve.imitation.images import image_flags
from spikeserve.imitation.options import ImitationOptions
from spikeserve.imitation.training import Spiketrain, Training

SPIKETRAIN = os.environ["SPIKETRAIN"]


class RecordEpisodeStatistics(gymnasium.wrappers.RecordEpisodeStatistics):
    """Another one of the same short name."""


def test_a_run_continues_with_what_it_began_with_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "_Run", lambda *_: types.SimpleNamespace(run=lambda: None))
    monkeypatch.setattr(pipeline.Spiketrain, "check_flags", lambda *_: None)
    wrapped = gymnasium.wrappers.RecordEpisodeStatistics
    shorter = functools.partial(wrapped, buffer_length=1)

    def imitate(env_id="home_made:HomeMade-v0", expert=home_made.go_to_corner, wrapper=wrapped, **others):
        spikeserve.imitate(env_id, expert, tmp_path, wrappers=[wrapper], spiketrain=SPIKETRAIN, **others)

    imitate()
    imitate()
    with pytest.raises(ValueError, match="out: expected the settings of .* received other env_id"):
        imitate("json:HomeMade-v0")
    with pytest.raises(ValueError, match="out: expected the settings of .* received other wrappers"):
        imitate(wrapper=RecordEpisodeStatistics)
    for unclear, name in (({"expert": lambda observation: 0}, "<lambda>"), ({"wrapper": shorter}, "functools.partial")):
        with pytest.raises(ValueError, match=f"out: expected another folder, or --overwrite, because no name says .*{name}"):
            imitate(**unclear)
        imitate(**unclear, overwrite=True)
    imitate(overwrite=True)
    settings = json.loads((tmp_path / "settings.json").read_text())
    for added in ("env_id", "wrappers"):  # which earlier releases did not write down
        del settings[added]
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    imitate()
    assert json.loads((tmp_path / "settings.json").read_text())["env_id"] == "home_made:HomeMade-v0"


def test_patches_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ValueError, match="patch_size: expected a divisor of 28 and 20, received 3"):
        image_flags(spaces.Box(0, 255, (28, 20, 3), np.uint8), 3)
    with pytest.raises(ValueError, match="patch_size: expected an image of uint8"):
        image_flags(spaces.Discrete(3), 4)
    with pytest.raises(ValueError, match="patch_size: expected a divisor of 16 and 16, received 5"):
        options = ImitationOptions(patch_size=5)
        arguments = ("home_made:Picture-v0", home_made.go_to_dot)
        spikeserve.imitate(*arguments, tmp_path, options=options, spiketrain=SPIKETRAIN)
    assert not list(tmp_path.iterdir()), "before anything is recorded"


def test_looking_back_needs_phase_spikes():
    with pytest.raises(ValueError, match="mode: expected pos or full beside lookback, received .?baseline"):
        ImitationOptions(lookback=3)
    assert ImitationOptions(lookback=3, mode="pos").lookback == 3


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (("--slope=4", "--arithmetic=integer"), "expected no --arithmetic, because stages continue from float32 weights"),
        (("--arithmetic", "integer"), "expected no --arithmetic"),
        (("--lookback=3",), "expected no --lookback; lookback, mirror and patch_size are settings of imitate"),
        (("--mirror=3",), "expected no --mirror"),
        (("--image_shape=16,16,3",), "expected no --image_shape"),
        (("--init=policy.safetensors",), "expected no --init, which each stage sets"),
        (("--target_rate=5",), "expected no --target_rate, which each stage sets"),
        (("--activity_router",), "expected no --activity_router beside rounds or silence"),
        (("--norm=fade",), "expected no --norm beside rounds or silence"),
    ],
)
def test_train_flags_that_a_later_stage_would_refuse_are_refused(flags, reason):
    with pytest.raises(ValueError, match=f"train_flags: {reason}.*received --"):
        ImitationOptions(train_flags=flags)


def test_one_stage_takes_the_flags_of_new_policies():
    assert ImitationOptions(train_flags=("--norm=fade",), rounds=0, silence=()).rounds == 0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--train-flags=--arithmetic=integer", "train_flags: expected no --arithmetic"),
        ("--train-flags=--slpoe=4", "train_flags: expected flags that `spiketrain train` takes, received --slpoe=4: "),
        ("--train-flags=--slope=-1", "--slope: expected a number above 0, received -1"),
        ("--mode=position", "mode: expected one of baseline, pos, route, full, dense, received 'position'"),
        ("--hidden-size=50", "hidden_size: expected a multiple of heads = 4, received 50"),
        ("--ticks=1000", "ticks: expected an integer from 1 to 256, received 1000"),
        ("--silence=6:25,600:25", "silence: expected pairs HIDDEN:READOUT of percentages from 0 to 100, received 600:25"),
        ("--selection-episodes=1", "selection_episodes: expected at least 2 beside silence"),
        ("--expert=nothing-v0", "nothing-v0: expected a dataset of Minari, an id on this machine or a folder, received none"),
        ("--out=/dev/null/run", "spikeserve imitate: [Errno 20] Not a directory"),
        ("--silence=6:-1", "silence: expected pairs HIDDEN:READOUT of percentages from 0 to 100, received 6:-1"),
    ],
)
def test_the_command_refuses_what_no_training_takes_before_it_records(tmp_path, flags, message):
    command = [sys.executable, "-m", "spikeserve", "imitate", "CartPole-v1", "--expert=home_made:balance"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    finished = run(*command, f"--out={tmp_path}/run", flags, status=1, env=environment)
    assert message in finished.stderr
    assert not (tmp_path / "run").exists(), "corrected, the same command begins"


def test_a_hidden_size_fits_the_heads_of_train_flags():
    for flags in (("--heads=5",), ("--slope=4", "--heads", "5")):
        assert ImitationOptions(hidden_size=50, train_flags=flags).hidden_size == 50
        with pytest.raises(ValueError, match="hidden_size: expected a multiple of heads = 5, received 64"):
            ImitationOptions(train_flags=flags)


def test_trainings_have_the_threads_of_the_options(tmp_path):
    """Only the words are checked: two threads on a busy machine take minutes."""
    program = tmp_path / "spiketrain"
    program.write_text("#!/bin/sh\necho \"$@\"\n")
    program.chmod(0o755)
    for threads, expected in ((1, 0), (2, 1)):
        trainer = Spiketrain(str(program), threads, tmp_path)
        trainer.train(Training([], seed=1, iterations=1, flags=[]), tmp_path / "run")
        assert trainer.commands[0].count("--threads=2") == expected


def test_a_missing_program_is_named(tmp_path):
    with pytest.raises(ValueError, match="spiketrain: expected a program, received /no/spiketrain"):
        spikeserve.imitate("CartPole-v1", home_made.balance, tmp_path, spiketrain="/no/spiketrain")
