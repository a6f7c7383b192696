#!/usr/bin/env bash
# Trains the shipped Pendulum policy: first to play, then, in steps, to play silently.
#
# usage: train/recipes/pendulum.sh SPIKETRAIN OUT_DIR
environment=Pendulum-v1
source "$(dirname "$0")/recipe.sh"

# The optimal swing-up has no margin, the robust expert's has some. Bursts of random actions and wide starts show the
# ways back; half of the action tokens are noise, because from them the policy would read who is acting.
data disturbed --expert=robust --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

# The present state tells everything, so short clips teach the same in a third of the time; the last stage sees whole
# windows.
common=(--slope=4 --action_noise=0.5 --batch=64 --clip_steps=5)
stage 1-play disturbed --mode=full --seed=1 --iterations=1500 --learning_rate=3e-3 "${common[@]}"
stage 2-quiet disturbed --seed=2 --iterations=400 --learning_rate=2e-3 --target_rate=2.5 --readout_rate=15 "${common[@]}"
stage 3-quieter disturbed --seed=3 --iterations=400 --learning_rate=2e-3 --target_rate=1 --readout_rate=8 "${common[@]}"
stage 4-settled disturbed --seed=4 --iterations=300 --learning_rate=1e-3 --target_rate=1 --readout_rate=8 \
  --slope=4 --action_noise=0.5 --batch=16

unseen
