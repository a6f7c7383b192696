#!/usr/bin/env bash
# Trains a policy for LunarLanderContinuous-v3 (package gymnasium[box2d]) whose decisions take effect 0 to 5 beats after their
# observations. The expert is Gymnasium's heuristic, which is asked in the states in which a decision is executed
# (docs/guides/imitation.md, "Late decisions"). With USUAL=1 it trains the same without a delay, to compare.
#
# usage: train/recipes/lunarlander-delay.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

late=(--delay=0..5 --action-noise=0)
if [[ ${USUAL:-} ]]; then late=(); fi
imitate LunarLanderContinuous-v3 --expert=gymnasium.envs.box2d.lunar_lander:heuristic "${late[@]}" --mode=full --layers=1 \
  --steps=40000 --burst-rate=0.2 --longest-burst=6 --held-bursts=0.5 --iterations=1000 --rounds=3 --round-disturbed=0.3 \
  --round-steps=15000 --round-iterations=500 --silence=6:25,3:15 --silence-iterations=300
