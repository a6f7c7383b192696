"""Runs `imitate` on Spring-v0 in a small form. With a second argument, presses Ctrl-C when the training begins."""

import signal
import sys

from spikeserve.__main__ import main
from spikeserve.imitation import training

if len(sys.argv) > 2:
    training.Spiketrain.train = lambda *_: signal.raise_signal(signal.SIGINT)

SMALL = "--environments=3 --steps=300 --hidden-size=16 --batch=2 --iterations=2 --rounds=0 --silence= --episodes=2"
FLAGS = [*SMALL.split(), "--selection-episodes=2", "--train-flags=--heads=2"]
sys.argv = ["spikeserve", "imitate", "hidden_state:Spring-v0", "--expert=hidden_state:hold", f"--out={sys.argv[1]}", *FLAGS]
sys.exit(main())
