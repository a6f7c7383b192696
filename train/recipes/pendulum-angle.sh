#!/usr/bin/env bash
# Trains a policy for Pendulum without velocities. Unfinished: see docs/paper.md for how far it gets.
#
# usage: train/recipes/pendulum-angle.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyPendulum-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --expert=robust --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

# A few steps show the velocity; the second stage sees whole windows.
stage 1-play disturbed --mode=full --seed=1 --iterations=1000 --batch=32 --clip_steps=8 --learning_rate=3e-3 --slope=4
stage 2-whole disturbed --seed=2 --iterations=300 --batch=16 --learning_rate=1e-3 --slope=4

# What the policy gets into by itself, where its own actions tell nothing of the expert's.
round() { data "$1" --seed="$2" --expert=robust --steps=60000 --expert_fraction=0 --student="$policy"; }
round round1 1
stage 3-own disturbed,round1 --seed=3 --iterations=1500 --batch=32 --clip_steps=10 --slope=4 --learning_rate=3e-3
# What is far back misleads a policy that has only seen short clips: from here on, whole windows.
whole=(--batch=16 --slope=4 --learning_rate=2e-3)
round round2 2
stage 4-whole disturbed,round1,round2 --seed=4 --iterations=1200 "${whole[@]}"
round round3 3
stage 5-whole disturbed,round1,round2,round3 --seed=5 --iterations=1200 "${whole[@]}"
# A policy that reads its own last action copies it: half of the action tokens are noise from here on.
whole=(--batch=16 --slope=4 --learning_rate=2e-3 --action_noise=0.5)
round round4 4
stage 6-noise disturbed,round2,round3,round4 --seed=6 --iterations=1500 "${whole[@]}"
round round5 5
stage 7-noise disturbed,round3,round4,round5 --seed=7 --iterations=1500 "${whole[@]}"

unseen
