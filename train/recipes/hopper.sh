#!/usr/bin/env bash
# Trains a policy for Gymnasium's Hopper-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/hopper.json has it.
#
#   python train/recipes/ars.py Hopper-v5 --steps=1767464 --out=train/recipes/linear/hopper.json
#
# usage: train/recipes/hopper.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

settings=() # `imitate` chooses
imitate Hopper-v5 --expert=experts:hop
integer
