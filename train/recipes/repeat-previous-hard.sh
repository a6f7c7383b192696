#!/usr/bin/env bash
# Trains the shipped policy for POPGym's RepeatPrevious with k = 64 (package popgym).
#
# usage: train/recipes/repeat-previous-hard.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# The card that is asked for is in the oldest of 64 steps, where attention looks from the first iteration on.
imitate popgym:popgym-RepeatPreviousHard-v0 --expert=memory_experts:repeat_previous --mode=pos --action-noise=0 \
  --disturbed=0 --rounds=0 --hidden-size=128 --layers=1 --context=64 --lookback=63 --clip-steps=155 --batch=4 --steps=60000 \
  --iterations=400 --silence=30:30,20:20 --silence-iterations=150 --tolerance=0.005 --selection-episodes=50 \
  --episodes=200 --train-flags="--slope=4 --heads=8 --ffn_size=128"
integer
