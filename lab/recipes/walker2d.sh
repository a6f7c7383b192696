#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's Walker2d-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/walker2d.json has it.
#
#   python lab/recipes/ars.py Walker2d-v5 --steps=7569154 --out=lab/recipes/linear/walker2d.json
#
# usage: lab/recipes/walker2d.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# As in half-cheetah.sh, with rarer bursts, because it can fall.
imitate Walker2d-v5 --expert=experts:walk --burst-rate=0.02 --longest-burst=2 --context=2 --clip-steps=2 --iterations=2000 \
  --rounds=2 --round-disturbed=0.5 --round-steps=20000 --round-iterations=1000 --silence-iterations=800 \
  --selection-episodes=50
integer
