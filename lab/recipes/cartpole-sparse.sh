#!/usr/bin/env bash
# Trains a CartPole policy that uses fewer than ten spikes per decision, phase spikes included. It has one small layer
# and three ticks. Takes five minutes on one core.
#
# usage: lab/recipes/cartpole-sparse.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

data mixed --steps=100000 --expert_fraction=0.5 --disturbed_fraction=0.5

# A single phase generator emits 1.5 spikes per decision; this leaves the rest for the readout.
shape=(--mode=full --layers=1 --heads=1 --hidden_size=32 --ticks=3)
short=(--batch=64 --clip_steps=5 --slope=4 --learning_rate=3e-3)
stage 1-play mixed --seed=1 --iterations=1000 "${shape[@]}" "${short[@]}"
stage 2-quiet mixed --seed=2 --iterations=1000 --target_rate=0.5 --readout_rate=5 "${short[@]}"
stage 3-quieter mixed --seed=3 --iterations=1000 --target_rate=0.1 --readout_rate=4 "${short[@]}"

unseen
integer --mode=baseline
