#!/usr/bin/env bash
# Trains the shipped CartPole dial, a policy that lasts as long as the return asked for: first to play, then, in steps,
# to play silently.
#
# usage: train/recipes/cartpole-dial.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

data skills --expert=dial --steps=200000 --expert_fraction=0.5 --disturbed_fraction=0.5

# State and return-to-go tell everything, so short clips teach the same in a third of the time; the last stage sees whole
# windows.
short=(--batch=64 --clip_steps=5 --learning_rate=2e-3)
stage 1-play skills --mode=full --seed=1 --iterations=600 "${short[@]}"
stage 2-quiet skills --seed=2 --iterations=300 --target_rate=1 --readout_rate=6 "${short[@]}"
stage 3-whole skills --seed=3 --iterations=250 --target_rate=0.5 --readout_rate=4 --batch=16 --learning_rate=1e-3

dial 25 75 125 175 225 275 325 375 425 475
