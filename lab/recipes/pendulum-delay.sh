#!/usr/bin/env bash
# Trains a policy for Pendulum-v1 whose decisions take effect 0 to 5 beats after their observations, by how far away its
# server is. Its expert bears every delay (late.py), so the policy imitates the expert's action of the same beat, in an
# environment that executes actions late.
#
# usage: lab/recipes/pendulum-delay.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# What was executed last shows in the change of the observation. In this environment the past actions of the policy's memory
# are those that it decided, and on a robot those that were executed, so all of them are replaced by noise.
imitate late:LatePendulum-v0 --expert=late:swing_up --mode=full --layers=1 --context=3 --clip-steps=3 --action-noise=1 \
  --steps=40000 --burst-rate=0.2 --longest-burst=6 --held-bursts=0.5 --iterations=1500 --rounds=3 --round-disturbed=0.3 \
  --round-steps=20000 --round-iterations=600 --silence=6:25,3:15 --silence-iterations=300 --episodes=1000 \
  --train-flags="--slope=4 --observation_changes=true"
# Rounding alone loses 13.7 of the return.
train_integer --seed=4 --iterations=800 --clip_steps=3 --batch=64 --slope=4 --learning_rate=5e-4 --warmup=10 --action_noise=1 \
  --target_rate=3 --readout_rate=15
