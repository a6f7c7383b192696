#!/usr/bin/env bash
# Trains a policy for Gymnasium's HalfCheetah-v5 (package gymnasium[mujoco]). Its expert is linear: ars.py found it
# from nothing, and linear/half-cheetah.json has it.
#
#   python train/recipes/ars.py HalfCheetah-v5 --steps=1280000 --out=train/recipes/linear/half-cheetah.json
#
# usage: train/recipes/half-cheetah.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

settings=() # `imitate` chooses
imitate HalfCheetah-v5 --expert=experts:gallop
integer
