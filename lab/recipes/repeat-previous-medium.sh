#!/usr/bin/env bash
# Trains the shipped policy for POPGym's RepeatPrevious with k = 32 (package popgym), with a single tick.
#
# usage: lab/recipes/repeat-previous-medium.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# The card that is asked for is in the oldest of 32 steps, where attention looks from the first iteration on.
imitate popgym:popgym-RepeatPreviousMedium-v0 --expert=memory_experts:repeat_previous --mode=pos --ticks=1 --action-noise=0 \
  --disturbed=0 --rounds=0 --hidden-size=128 --layers=1 --context=32 --lookback=31 --clip-steps=103 --batch=8 --steps=40000 \
  --iterations=1500 --silence=10:40 --silence-iterations=2000 --tolerance=0.005 --selection-episodes=50 --episodes=200 \
  --train-flags="--slope=4 --heads=8 --ffn_size=128"
# Rounding costs a policy with few ticks more than one with eight, so it is trained through it.
train_integer --seed=4 --iterations=800 --clip_steps=103 --batch=8 --slope=4 --learning_rate=3e-4 --warmup=10 --target_rate=12 \
  --readout_rate=45
