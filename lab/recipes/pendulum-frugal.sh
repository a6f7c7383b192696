#!/usr/bin/env bash
# Trains the frugal Pendulum policy: mode baseline, one layer, ten ticks, and a penalty on synaptic operations.
#
# usage: lab/recipes/pendulum-frugal.sh SPIKETRAIN OUT_DIR
environment=Pendulum-v1
source "$(dirname "$0")/recipe.sh"

# As in pendulum.sh: an expert with a margin, bursts, wide starts, and noise in half of the action tokens.
data cautious --expert=cautious --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

# Membranes are updated whether neurons fire or not, so fewer neurons and ticks save more than silence does.
shape=(--mode=baseline --layers=1 --heads=4 --hidden_size=96 --ticks=10)
short=(--batch=64 --clip_steps=5 --slope=4 --action_noise=0.5)
quiet=(--target_rate=8 --readout_rate=60 --operation_penalty=0.02)
stage 1-play cautious --seed=1 --iterations=2500 --learning_rate=3e-3 "${shape[@]}" "${short[@]}"
# Records the states that the policy itself reaches.
data student --seed=1 --steps=80000 --expert_fraction=0 --expert=cautious --student="$policy"
stage 2-own cautious,student --seed=2 --iterations=2500 --learning_rate=2e-3 "${quiet[@]}" "${short[@]}"
data student2 --seed=2 --steps=80000 --expert_fraction=0 --expert=cautious --student="$policy"
stage 3-own cautious,student,student2 --seed=3 --iterations=3000 --learning_rate=1e-3 "${quiet[@]}" "${short[@]}"

unseen
integer
