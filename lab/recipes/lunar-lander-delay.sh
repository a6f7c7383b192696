#!/usr/bin/env bash
# Trains a policy for LunarLanderContinuous-v3 (package gymnasium[box2d]) whose decisions take effect 0 to 5 beats after their
# observations. Its expert bears every delay (late.py).
#
# usage: lab/recipes/lunar-lander-delay.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

imitate late:LateLunarLander-v0 --expert=late:land --mode=full --layers=1 --context=3 --clip-steps=3 --action-noise=1 \
  --steps=40000 --burst-rate=0.2 --longest-burst=6 --held-bursts=0.5 --iterations=1200 --rounds=2 --round-disturbed=0.3 \
  --round-steps=15000 --round-iterations=500 --silence=6:25,3:15 --silence-iterations=300
integer --mode=baseline
