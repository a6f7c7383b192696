#!/usr/bin/env bash
# Trains the shipped CartPole dial, a policy whose episodes last as long as the target return: first to play well, then
# in several stages to use fewer spikes.
#
# usage: lab/recipes/cartpole-dial.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

# The policy must distinguish the returns-to-go of the last steps, which --return_scale ensures, and must see these steps
# often enough, which --weigh ensures.
data skills --expert=return_conditioned --weigh --steps=200000 --expert_fraction=0.5 --disturbed_fraction=0.5

# The current state and return-to-go are sufficient for the decision, so short clips give the same policy in a third of
# the time. The last stage trains on whole windows.
short=(--batch=64 --clip_steps=5 --learning_rate=2e-3)
stage 1-play skills --mode=full --seed=1 --iterations=600 --return_offset=20 --return_scale=20 "${short[@]}"
stage 2-quiet skills --seed=2 --iterations=300 --target_rate=1 --readout_rate=6 "${short[@]}"
stage 3-whole skills --seed=3 --iterations=250 --target_rate=0.5 --readout_rate=4 --batch=16 --learning_rate=1e-3

dial 25 75 125 175 225 275 325 375 425 475
integer --mode=route
