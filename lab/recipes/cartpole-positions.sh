#!/usr/bin/env bash
# Trains the shipped policy for CartPole without velocities: first to play well, then in several stages to use fewer
# spikes.
#
# usage: lab/recipes/cartpole-positions.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyCartPole-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --steps=100000 --expert_fraction=0.3 --disturbed_fraction=0.7

# A few steps are enough to infer the velocities. With more of them a policy learns to repeat its own last action
# instead: with whole windows of 20 its loss is lower, but so is its return.
short=(--batch=32 --clip_steps=8 --learning_rate=2e-3 --slope=4)
stage 1-play disturbed --mode=full --context=10 --seed=1 --iterations=1500 "${short[@]}"
stage 2-quiet disturbed --seed=2 --iterations=800 --target_rate=2 --readout_rate=12 "${short[@]}"
stage 3-quieter disturbed --seed=3 --iterations=800 --target_rate=1 --readout_rate=8 "${short[@]}"

unseen
integer --mode=route
