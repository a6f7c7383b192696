#!/usr/bin/env bash
# Trains a policy for CartPole-v1 whose decisions take effect 0 to 5 beats after their observations, by how far away its
# server is. Its expert bears every delay (late.py), so the policy imitates the expert's action of the same beat, in an
# environment that executes actions late.
#
# usage: lab/recipes/cartpole-delay.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# What was executed last shows in the change of the observation. In this environment the past actions of the policy's memory
# are those that it decided, and on a robot those that were executed, so all of them are replaced by noise.
imitate late:LateCartPole-v0 --expert=late:balance --mode=full --layers=1 --context=3 --clip-steps=3 --action-noise=1 \
  --steps=40000 --burst-rate=0.1 --longest-burst=4 --iterations=1500 --rounds=3 --round-disturbed=0.3 --round-steps=20000 \
  --round-iterations=600 --silence=6:25,3:15 --silence-iterations=300 --episodes=1000
integer --mode=baseline
