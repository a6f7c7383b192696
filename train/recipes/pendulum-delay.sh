#!/usr/bin/env bash
# Trains a policy for Pendulum-v1 whose decisions take effect 0 to 5 beats after their observations, by how far away its
# server is. The expert is the one of the other recipes for Pendulum; it is asked in the states in which a decision is
# executed (docs/guides/imitation.md, "Late decisions").
#
# usage: train/recipes/pendulum-delay.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"
mkdir -p "$out"
SPIKETRAIN_TABLES=$(realpath "$out")/tables
export SPIKETRAIN_TABLES
"$spiketrain" expert --env=Pendulum-v1 --expert=cautious --tables="$SPIKETRAIN_TABLES" --episodes=1

# The delay shows only in what was executed after an observation, so no past action is replaced by noise. The rounds
# matter most: recorded data never show what late decisions lead to.
imitate Pendulum-v1 --expert=experts:swing_up --delay=0..5 --mode=full --layers=1 --action-noise=0 --steps=40000 \
  --burst-rate=0.2 --longest-burst=6 --held-bursts=0.5 --iterations=1500 --rounds=6 --round-disturbed=0.3 \
  --round-steps=20000 --round-iterations=800 --silence=6:25,3:15 --episodes=1000
