#!/usr/bin/env bash
# Trains the frugal CartPole policy: mode baseline, one small layer, three ticks, and a penalty on synaptic operations.
#
# usage: lab/recipes/cartpole-frugal.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

data mixed --steps=100000 --expert_fraction=0.5 --disturbed_fraction=0.5

# Membranes are updated whether neurons fire or not, so fewer neurons and ticks save more than silence does.
shape=(--mode=baseline --norm=fade --layers=1 --heads=1 --hidden_size=32 --ticks=3)
short=(--batch=64 --clip_steps=5 --slope=4 --learning_rate=3e-3)
stage 1-play mixed --seed=1 --iterations=800 "${shape[@]}" "${short[@]}"
stage 2-quiet mixed --seed=2 --iterations=600 --target_rate=0.5 --readout_rate=5 --operation_penalty=1 "${short[@]}"

unseen
integer
