#!/usr/bin/env bash
# Trains a policy for Gymnasium's LunarLander-v3 (package gymnasium[box2d]) with a single tick, as lunar-lander.sh does.
#
# usage: lab/recipes/lunar-lander-tick.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

imitate LunarLander-v3 --expert=experts:land --ticks=1 --iterations=5000 --round-iterations=2500 --tolerance=0.01 \
  --silence=25:80,12:40,8:30 --silence-iterations=2000 --episodes=1000
integer
