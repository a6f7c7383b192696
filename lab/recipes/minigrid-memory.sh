#!/usr/bin/env bash
# Trains the shipped policy for MiniGrid's MemoryS11 (package minigrid): the agent looks at an object, walks through a hallway
# and goes to the equal one of two objects.
#
# usage: lab/recipes/minigrid-memory.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# A key and a ball differ by one in a grid of numbers, so the observation is one-hot. The expert notes what it sees by an action
# without effect (memory_experts.py), so actions carry no noise. The context covers the way from the object to the choice.
imitate minigrid:MiniGrid-MemoryS11-v0 --wrapper=minigrid.wrappers:OneHotPartialObsWrapper \
  --wrapper=minigrid.wrappers:ImgObsWrapper --expert=memory_experts:find_match --context=16 --clip-steps=0 --batch=24 \
  --action-noise=0 --train-flags="--slope=4 --merge=concat" --steps=20000 --disturbed=0.5 --burst-rate=0.1 --longest-burst=2 \
  --iterations=800 --rounds=2 --round-steps=6000 --round-iterations=300 --silence-iterations=300 --episodes=1000
integer
