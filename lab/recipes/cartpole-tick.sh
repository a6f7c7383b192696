#!/usr/bin/env bash
# Trains a CartPole policy of the paper's size with a single tick: a row of weights is read at most once a decision.
#
# usage: lab/recipes/cartpole-tick.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

data mixed --steps=100000 --expert_fraction=0.5 --disturbed_fraction=0.5

short=(--batch=64 --clip_steps=5 --slope=4 --learning_rate=2e-3)
stage 1-play mixed --seed=1 --iterations=1000 --mode=baseline --norm=fade --ticks=1 "${short[@]}"
stage 2-quiet mixed --seed=2 --iterations=800 --target_rate=2 --readout_rate=10 "${short[@]}"

unseen
integer
