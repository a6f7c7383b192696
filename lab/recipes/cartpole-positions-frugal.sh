#!/usr/bin/env bash
# Trains the frugal policy for CartPole without velocities: mode baseline, one layer, and a penalty on synaptic
# operations. The changes of the positions since the last step stand for the velocities.
#
# usage: lab/recipes/cartpole-positions-frugal.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyCartPole-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --steps=100000 --expert_fraction=0.3 --disturbed_fraction=0.7

shape=(--mode=baseline --layers=1 --heads=1 --hidden_size=32 --ticks=3 --context=3 --observation_changes=true)
short=(--batch=64 --clip_steps=5 --slope=4 --learning_rate=3e-3 --action_noise=0.5)
stage 1-play disturbed --seed=1 --iterations=1000 "${shape[@]}" "${short[@]}"
# Records the states that the policy itself reaches.
data student --seed=1 --steps=60000 --expert_fraction=0 --student="$policy"
stage 2-quiet disturbed,student --seed=2 --iterations=800 --target_rate=0.5 --readout_rate=5 --operation_penalty=1 "${short[@]}"

unseen
integer
