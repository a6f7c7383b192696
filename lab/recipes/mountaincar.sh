#!/usr/bin/env bash
# Trains the shipped MountainCar policy: first to play well, then in several stages to use fewer spikes.
#
# usage: lab/recipes/mountaincar.sh SPIKETRAIN OUT_DIR
environment=MountainCar-v0
source "$(dirname "$0")/recipe.sh"

# Bursts of random actions leave the expert's few trajectories; the expert's actions label the states reached there.
data disturbed --steps=100000 --expert_fraction=0.2 --disturbed_fraction=0.8

# The current state is sufficient for the decision, so short clips give the same policy in a third of the time. The last
# stages train on whole windows.
short=(--batch=64 --clip_steps=5 --learning_rate=2e-3)
whole=(--batch=16 --learning_rate=1e-3)
stage 1-play disturbed --mode=full --seed=1 --iterations=400 "${short[@]}"
stage 2-quiet disturbed --seed=2 --iterations=300 --target_rate=1 --readout_rate=6 "${short[@]}"
stage 3-quieter disturbed --seed=3 --iterations=300 --target_rate=0.5 --readout_rate=4 "${short[@]}"
stage 4-whole disturbed --seed=4 --iterations=200 --target_rate=0.4 --readout_rate=3.5 "${whole[@]}"
stage 5-silent disturbed --seed=5 --iterations=300 --target_rate=0.2 --readout_rate=2 "${whole[@]}"

unseen
integer
