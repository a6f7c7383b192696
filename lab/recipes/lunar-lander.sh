#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's LunarLander-v3 (package gymnasium[box2d]). The expert is Gymnasium's heuristic
# with other constants (experts.py): the heuristic itself slides off the pad in one of ten episodes.
#
# usage: lab/recipes/lunar-lander.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

imitate LunarLander-v3 --expert=experts:land --iterations=2500 --round-iterations=1000 --tolerance=0.01 --episodes=1000
integer
