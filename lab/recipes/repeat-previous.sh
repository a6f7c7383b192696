#!/usr/bin/env bash
# Trains the shipped policy for POPGym's RepeatPrevious with k = 4 (package popgym), with a single tick.
#
# usage: lab/recipes/repeat-previous.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# The card that is asked for is in the oldest of four steps, where attention looks from the first iteration on. With seed 0 the
# 8-bit weights lost 0.014 of the return (500 starts from seed 1,000,000).
imitate popgym:popgym-RepeatPreviousEasy-v0 --expert=memory_experts:repeat_previous --mode=pos --ticks=1 --action-noise=0 \
  --disturbed=0 --rounds=0 --layers=1 --context=4 --lookback=3 --clip-steps=51 --batch=16 --steps=40000 --iterations=2000 \
  --silence=20:50,10:40,6:30 --silence-iterations=1500 --tolerance=0.005 --episodes=1000 --seed=1
# Rounding costs a policy with few ticks more than one with eight, so it is trained through it.
train_integer --seed=4 --iterations=800 --clip_steps=51 --batch=16 --slope=4 --learning_rate=1e-3 --warmup=10 --target_rate=6 \
  --readout_rate=30
