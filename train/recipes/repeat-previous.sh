#!/usr/bin/env bash
# Trains the shipped policy for POPGym's RepeatPrevious with k = 4 (package popgym).
#
# usage: train/recipes/repeat-previous.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# The card that is asked for is in the oldest of four steps. Phase spikes (mode full) tell the steps apart.
imitate popgym:popgym-RepeatPreviousEasy-v0 --expert=memory_experts:repeat_previous --mode=full --action-noise=0 --disturbed=0 \
  --rounds=0 --layers=1 --context=4 --clip-steps=51 --batch=8 --steps=40000 --iterations=1600 --silence=6:25,3:15 \
  --silence-iterations=500 --tolerance=0.005 --episodes=1000
integer
