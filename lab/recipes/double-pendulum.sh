#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's InvertedDoublePendulum-v5 (package gymnasium[mujoco]): first on the data of a
# linear-quadratic regulator (experts.py), then on the states that the policy itself reaches.
#
# usage: lab/recipes/double-pendulum.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# One random force moves the cart by 2 m/s, so a longer burst would only show falling pendulums. The observation is the
# whole state, so a short context is enough. No stage reduces the spikes.
imitate InvertedDoublePendulum-v5 --expert=experts:balance_double_pendulum --mode=full --ticks=10 --action-noise=0 \
  --learning-rate=0.002 --longest-burst=1 --burst-rate=0.1 --rounds=1 --round-steps=20000 --round-iterations=500 \
  --silence= --silence-iterations=400 --selection-episodes=20 --episodes=100
integer
