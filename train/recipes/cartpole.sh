#!/usr/bin/env bash
# Trains the shipped CartPole policy: first to play, then, in steps, to play silently. About twenty minutes on one core.
#
# usage: train/recipes/cartpole.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

# The paper's 10,000 steps are enough to learn to play. A quiet policy is imprecise, and needs more starts to learn from:
# near them random steps are so frequent that in the end they drown the expert's, so the last two stages do without.
data small --steps=10000
data large --steps=100000
data expert --steps=100000 --expert_fraction=1

stage 1-play small --mode=full --seed=1 --iterations=400
stage 2-quiet large --seed=2 --iterations=400 --learning_rate=2e-3 --target_rate=1 --readout_rate=6
stage 3-quieter large --seed=3 --iterations=400 --learning_rate=2e-3 --target_rate=0.3 --readout_rate=3
stage 4-silent expert --seed=4 --iterations=300 --learning_rate=2e-3 --target_rate=0.2 --readout_rate=2.5
stage 5-settled expert --seed=5 --iterations=300 --learning_rate=1.5e-3 --target_rate=0.2 --readout_rate=2.5

unseen
