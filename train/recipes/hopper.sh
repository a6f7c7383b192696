#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's Hopper-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/hopper.json has it.
#
# usage: train/recipes/hopper.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

settings=() # `imitate` chooses
imitate Hopper-v5 --expert=experts:hop
integer
