#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's HalfCheetah-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/half-cheetah.json has it.
#
# usage: train/recipes/half-cheetah.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

settings=() # `imitate` chooses
imitate HalfCheetah-v5 --expert=experts:gallop
integer
