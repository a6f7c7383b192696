#!/usr/bin/env bash
# Trains the shipped CartPole policy: first to play well, then in several stages to use fewer spikes. Takes about twenty
# minutes on one core.
#
# usage: lab/recipes/cartpole.sh SPIKETRAIN OUT_DIR
environment=CartPole-v1
source "$(dirname "$0")/recipe.sh"

# The paper's 10,000 steps are enough to learn to play. A policy with few spikes is imprecise and needs data from more
# initial states. Near these, random steps are so frequent that they outweigh the expert's, so the last two stages train
# without them.
data small --steps=10000
data large --steps=100000
data expert --steps=100000 --expert_fraction=1

stage 1-play small --mode=full --seed=1 --iterations=400
stage 2-quiet large --seed=2 --iterations=400 --learning_rate=2e-3 --target_rate=1 --readout_rate=6
stage 3-quieter large --seed=3 --iterations=400 --learning_rate=2e-3 --target_rate=0.3 --readout_rate=3
stage 4-silent expert --seed=4 --iterations=300 --learning_rate=2e-3 --target_rate=0.2 --readout_rate=2.5
stage 5-settled expert --seed=5 --iterations=300 --learning_rate=1.5e-3 --target_rate=0.2 --readout_rate=2.5

unseen
integer
