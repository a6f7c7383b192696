#!/usr/bin/env bash
# Trains the shipped policy for POPGym's RepeatFirst (package popgym) on the smallest size, of 51 steps. It plays the other
# sizes, of 415 and 831 steps, as well.
#
# usage: lab/recipes/repeat-first.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# The first action names the first card, and every later one repeats the action before it: the policy remembers in the action
# tokens, so a context of two steps is enough. Clips are whole episodes, so half of them begin with the first card.
imitate popgym:popgym-RepeatFirstEasy-v0 --expert=memory_experts:repeat_first --hidden-size=32 --layers=1 --context=2 \
  --action-noise=0 --clip-steps=51 --batch=8 --steps=20000 --disturbed=0 --iterations=500 --rounds=0 \
  --silence-iterations=250 --episodes=1000
integer
