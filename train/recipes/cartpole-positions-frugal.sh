#!/usr/bin/env bash
# Trains the frugal policy for CartPole without velocities: mode baseline, one layer, and a penalty on synaptic
# operations.
#
# usage: train/recipes/cartpole-positions-frugal.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyCartPole-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --steps=100000 --expert_fraction=0.3 --disturbed_fraction=0.7

# Membranes are updated whether neurons fire or not, so fewer neurons and ticks save more than silence does. A few steps
# are enough to infer the velocities; the heads are concatenated, because their sum is too narrow to represent them.
shape=(--mode=baseline --merge=concat --layers=1 --heads=4 --hidden_size=64 --ticks=8 --context=5)
short=(--batch=32 --clip_steps=8 --slope=4)
quiet=(--target_rate=8 --readout_rate=60 --operation_penalty=0.02)
stage 1-play disturbed --seed=1 --iterations=1500 --learning_rate=3e-3 "${shape[@]}" "${short[@]}"
# Records the states that the policy itself reaches.
data student --seed=1 --steps=60000 --expert_fraction=0 --student="$policy"
stage 2-own disturbed,student --seed=2 --iterations=1500 --learning_rate=2e-3 "${quiet[@]}" "${short[@]}"

unseen
integer
