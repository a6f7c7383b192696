#!/usr/bin/env bash
# Trains the shipped policy for Pendulum without velocities: first to play, then, in steps, to play silently.
#
# usage: train/recipes/pendulum-angle.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyPendulum-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --expert=robust --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

# A few steps show the velocity; the last stage sees whole windows.
stage 1-play disturbed --mode=full --seed=1 --iterations=1000 --batch=32 --clip_steps=8 --learning_rate=3e-3 --slope=4
stage 2-whole disturbed --seed=2 --iterations=300 --batch=16 --learning_rate=1e-3 --slope=4

unseen
