#!/usr/bin/env bash
# Trains the frugal policy for Pendulum without velocities: mode baseline, one layer, and a penalty on synaptic operations.
# The change of the angle since the last step stands for the velocity.
#
# usage: lab/recipes/pendulum-angle-frugal.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyPendulum-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --expert=cautious --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

shape=(--mode=baseline --layers=1 --heads=4 --hidden_size=96 --ticks=10 --context=3 --observation_changes=true)
short=(--batch=64 --clip_steps=4 --slope=4 --action_noise=0.5)
quiet=(--target_rate=8 --readout_rate=60 --operation_penalty=0.02)
# Records the states that the policy itself reaches.
round() { data "$1" --seed="$2" --steps=80000 --expert_fraction=0 --expert=cautious --student="$policy"; }
stage 1-play disturbed --seed=1 --iterations=2000 --learning_rate=3e-3 "${shape[@]}" "${short[@]}"
round student 1
stage 2-own disturbed,student --seed=2 --iterations=2000 --learning_rate=2e-3 "${quiet[@]}" "${short[@]}"
round student2 2
stage 3-own disturbed,student,student2 --seed=3 --iterations=2500 --learning_rate=1e-3 "${quiet[@]}" "${short[@]}"

unseen
integer
