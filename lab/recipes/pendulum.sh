#!/usr/bin/env bash
# Trains the shipped Pendulum policy: first to play well, then in several stages to use fewer spikes.
#
# usage: lab/recipes/pendulum.sh SPIKETRAIN OUT_DIR
environment=Pendulum-v1
source "$(dirname "$0")/recipe.sh"

# The optimal swing-up has no margin, so a policy that imitates it often fails. The robust expert's has a large margin,
# the cautious expert's a small one. Bursts of random actions and wide starts show how to recover. Half of the action
# tokens are replaced by noise, because the policy could otherwise infer from them whether the expert is acting.
bursts=(--steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25)
data disturbed --expert=robust "${bursts[@]}"
data cautious --expert=cautious "${bursts[@]}"

# The current state is sufficient for the decision, so short clips give the same policy in a third of the time. Stages 5
# and 6 train on whole windows.
common=(--slope=4 --action_noise=0.5)
short=(--batch=64 --clip_steps=5 "${common[@]}")
stage 1-play disturbed --mode=full --seed=1 --iterations=1500 --learning_rate=3e-3 "${short[@]}"
stage 2-quiet cautious --seed=2 --iterations=600 --learning_rate=2e-3 --target_rate=2.5 --readout_rate=15 "${short[@]}"
stage 3-quieter cautious --seed=3 --iterations=400 --learning_rate=2e-3 --target_rate=1 --readout_rate=8 "${short[@]}"
stage 4-silent cautious --seed=4 --iterations=400 --learning_rate=2e-3 --target_rate=0.5 --readout_rate=5 "${short[@]}"
stage 5-whole cautious --seed=5 --iterations=300 --learning_rate=1e-3 --target_rate=0.4 --readout_rate=4.5 --batch=16 \
  "${common[@]}"
# Records the states that the policy itself reaches.
data student --seed=1 --steps=60000 --expert_fraction=0 --expert=cautious --student="$policy"
stage 6-own cautious,student --seed=6 --iterations=500 --learning_rate=1.5e-3 --target_rate=0.6 --readout_rate=6 \
  --batch=16 "${common[@]}"
data student2 --seed=2 --steps=80000 --expert_fraction=0 --expert=cautious --student="$policy"
stage 7-own cautious,student2 --seed=7 --iterations=900 --learning_rate=2e-3 --target_rate=1 --readout_rate=8 "${short[@]}"

unseen
integer
