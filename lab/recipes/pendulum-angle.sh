#!/usr/bin/env bash
# Trains the shipped policy for Pendulum without velocities, with a single tick.
#
# usage: lab/recipes/pendulum-angle.sh SPIKETRAIN OUT_DIR
environment=PositionOnlyPendulum-v1
source "$(dirname "$0")/recipe.sh"

data disturbed --expert=robust --steps=100000 --expert_fraction=0 --disturbed_fraction=1 --wide_start_fraction=0.25

# Five steps are enough to infer the velocity and too few to learn to repeat the own last action instead. Each of the two
# layers attends to four earlier steps, so with clips of twelve the policy uses no step in play that lies further back
# than those in training. Heads are concatenated: their sum is too narrow to represent a velocity.
common=(--batch=48 --clip_steps=12 --slope=4)
quiet=(--target_rate=5 --readout_rate=40 --operation_penalty=0.01)
# Records the states that the policy itself reaches.
round() { data "$1" --seed="$2" --expert=robust --steps=80000 --expert_fraction=0 --student="$policy"; }
stage 1-play disturbed --mode=pos --merge=concat --ticks=1 --observation_changes=false --context=5 --seed=1 --iterations=2000 \
  --learning_rate=3e-3 "${common[@]}"
round round1 1
stage 2-own disturbed,round1 --seed=2 --iterations=2500 --learning_rate=2e-3 "${common[@]}"
round round2 2
stage 3-own disturbed,round1,round2 --seed=3 --iterations=3000 --learning_rate=2e-3 "${quiet[@]}" "${common[@]}"
round round3 3
stage 4-own disturbed,round1,round2,round3 --seed=4 --iterations=4000 --learning_rate=1e-3 "${quiet[@]}" "${common[@]}"

unseen
integer
