#!/usr/bin/env bash
# Trains the shipped policy for POPGym's RepeatPrevious with k = 64 (package popgym), with two ticks.
#
# usage: lab/recipes/repeat-previous-hard.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# The card that is asked for is in the oldest of 64 steps, where attention looks from the first iteration on. With one tick the
# first training returned 0.91.
imitate popgym:popgym-RepeatPreviousHard-v0 --expert=memory_experts:repeat_previous --mode=pos --ticks=2 --action-noise=0 \
  --disturbed=0 --rounds=0 --hidden-size=128 --layers=1 --context=64 --lookback=63 --clip-steps=155 --batch=8 --steps=60000 \
  --iterations=1500 --silence=20:50,10:40 --silence-iterations=1000 --tolerance=0.005 --selection-episodes=50 --episodes=200 \
  --train-flags="--slope=4 --heads=8 --ffn_size=128"
# Rounding alone loses 0.07 of the return: it costs a policy with few ticks more than one with eight.
train_integer --seed=4 --iterations=800 --clip_steps=155 --batch=8 --slope=4 --learning_rate=3e-4 --warmup=10 --target_rate=12 \
  --readout_rate=45
