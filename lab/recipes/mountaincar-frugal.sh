#!/usr/bin/env bash
# Trains the frugal MountainCar policy: mode baseline, one layer, eight ticks, and a penalty on synaptic operations.
#
# usage: lab/recipes/mountaincar-frugal.sh SPIKETRAIN OUT_DIR
environment=MountainCar-v0
source "$(dirname "$0")/recipe.sh"

# Bursts of random actions leave the expert's few trajectories; the expert's actions label the states reached there.
data disturbed --steps=100000 --expert_fraction=0.2 --disturbed_fraction=0.8

# Membranes are updated whether neurons fire or not, so fewer neurons and ticks save more than silence does.
shape=(--mode=baseline --layers=1 --heads=4 --hidden_size=96 --ticks=8)
short=(--batch=64 --clip_steps=5 --slope=4)
stage 1-play disturbed --seed=1 --iterations=2500 --learning_rate=3e-3 "${shape[@]}" "${short[@]}"
stage 2-quiet disturbed --seed=2 --iterations=2000 --learning_rate=1e-3 --target_rate=6 --readout_rate=40 \
  --operation_penalty=0.02 "${short[@]}"
stage 3-fine disturbed --seed=3 --iterations=3000 --learning_rate=3e-4 --target_rate=6 --readout_rate=40 \
  --operation_penalty=0.02 "${short[@]}"

unseen
integer
