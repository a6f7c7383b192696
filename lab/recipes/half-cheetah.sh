#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's HalfCheetah-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/half-cheetah.json has it.
#
#   python lab/recipes/ars.py HalfCheetah-v5 --steps=1280000 --out=lab/recipes/linear/half-cheetah.json
#
# usage: lab/recipes/half-cheetah.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# Stronger bursts would cost the expert more than half of its return. The observation is the whole state, so a short context
# is enough.
imitate HalfCheetah-v5 --expert=experts:gallop --burst-rate=0.05 --longest-burst=3 --context=2 --clip-steps=2 --iterations=2000 \
  --rounds=2 --round-disturbed=0.5 --round-steps=20000 --round-iterations=1000 --silence-iterations=800 \
  --selection-episodes=50
integer
