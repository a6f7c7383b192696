#!/usr/bin/env bash
# Trains the shipped policy for CartPole without velocities: first to play, then, in steps, to play silently.
#
# usage: train/recipes/cartpole-positions.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyCartPole-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --steps=100000 --expert_fraction=0.3 --disturbed_fraction=0.7

# A few steps show the velocities; the last stage sees whole windows.
stage 1-play disturbed --mode=full --seed=1 --iterations=1500 --batch=32 --clip_steps=8 --learning_rate=2e-3 --slope=4
stage 2-whole disturbed --seed=2 --iterations=400 --batch=16 --learning_rate=1e-3 --slope=4

unseen
