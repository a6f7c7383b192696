#!/usr/bin/env bash
# Trains a MountainCar policy of the paper's size with a single tick: a row of weights is read at most once a decision.
#
# usage: lab/recipes/mountaincar-tick.sh SPIKETRAIN OUT_DIR
environment=MountainCar-v0
source "$(dirname "$0")/recipe.sh"

# Bursts of random actions leave the expert's few trajectories; the expert's actions label the states reached there.
data disturbed --steps=100000 --expert_fraction=0.2 --disturbed_fraction=0.8

# Noise in half of the action tokens, so that it does not learn to repeat its last action.
short=(--batch=64 --clip_steps=5 --slope=4 --action_noise=0.5)
quiet=(--target_rate=4 --readout_rate=25 --operation_penalty=0.01)
stage 1-play disturbed --seed=1 --iterations=2500 --learning_rate=2e-3 --mode=baseline --norm=fade --ticks=1 "${short[@]}"
# Records the states that the policy itself reaches.
data student --seed=1 --steps=60000 --expert_fraction=0 --student="$policy"
stage 2-own disturbed,student --seed=2 --iterations=4000 --learning_rate=1e-3 "${quiet[@]}" "${short[@]}"

unseen
integer
