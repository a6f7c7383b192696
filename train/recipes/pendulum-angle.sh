#!/usr/bin/env bash
# Trains the shipped policy for Pendulum without velocities.
#
# usage: train/recipes/pendulum-angle.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyPendulum-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --expert=robust --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

# Five steps are enough to infer the velocity and too few to learn to repeat the own last action instead. Each of the two
# layers attends to four earlier steps, so with clips of twelve the policy uses no step in play that lies further back
# than those in training.
common=(--batch=24 --clip_steps=12 --learning_rate=3e-3 --slope=4)
round() { data "$1" --seed="$2" --expert=robust --steps=60000 --expert_fraction=0 --student="$policy"; }
stage 1-scout disturbed --mode=full --context=5 --seed=1 --iterations=1500 "${common[@]}"
round round1 1

# Trains a new policy that concatenates the heads: their sum is too narrow to represent a velocity.
policy=
stage 2-play disturbed,round1 --mode=full --merge=concat --context=5 --seed=1 --iterations=1500 "${common[@]}"
round round2 2
stage 3-own disturbed,round1,round2 --seed=2 --iterations=1200 "${common[@]}"
round round3 3
stage 4-own disturbed,round1,round2,round3 --seed=3 --iterations=1500 "${common[@]}"

unseen
integer --mode=route
