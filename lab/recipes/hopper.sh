#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's Hopper-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/hopper.json has it.
#
#   python lab/recipes/ars.py Hopper-v5 --steps=1767464 --out=lab/recipes/linear/hopper.json
#
# usage: lab/recipes/hopper.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# One random action makes the expert fall in many episodes, so bursts are short and rare. The observation is the whole state,
# so a short context is enough.
imitate Hopper-v5 --expert=experts:hop --burst-rate=0.02 --longest-burst=1 --context=2 --clip-steps=2 --iterations=2000 \
  --rounds=2 --round-disturbed=0.5 --round-steps=20000 --round-iterations=1000 --silence-iterations=800 \
  --selection-episodes=50
integer
