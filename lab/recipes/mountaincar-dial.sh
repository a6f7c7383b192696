#!/usr/bin/env bash
# Trains the shipped MountainCar dial, a policy whose episodes take as many steps as the target return asks for: first to
# play well, then in several stages to use fewer spikes.
#
# usage: lab/recipes/mountaincar-dial.sh SPIKETRAIN OUT_DIR
environment=MountainCar-v0
source "$(dirname "$0")/recipe.sh"

data skills --expert=return_conditioned --steps=200000 --expert_fraction=0.5 --disturbed_fraction=0.5

# The current state and return-to-go are sufficient for the decision, so short clips give the same policy in a third of
# the time.
short=(--batch=64 --clip_steps=5 --learning_rate=2e-3)
stage 1-play skills --mode=full --seed=1 --iterations=600 --return_offset=-100 --return_scale=50 "${short[@]}"
stage 2-quiet skills --seed=2 --iterations=300 --target_rate=1 --readout_rate=6 "${short[@]}"
stage 3-whole skills --seed=3 --iterations=250 --target_rate=0.5 --readout_rate=4 --batch=16 --learning_rate=1e-3
# This policy waits too long and is then late, in states that the data do not contain. The next data show what the
# expert does in such states for the same target return.
data asked --seed=1 --expert=return_conditioned --steps=120000 --expert_fraction=0.3 --disturbed_fraction=0.7
data student --seed=2 --expert=return_conditioned --steps=60000 --expert_fraction=0 --student="$policy"
stage 4-asked asked,student --seed=4 --iterations=450 --target_rate=1 --readout_rate=6 "${short[@]}"

dial -105 -115 -125 -135 -145 -155 -165 -175 -185 -195
integer
