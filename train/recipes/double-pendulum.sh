#!/usr/bin/env bash
# Trains the shipped policy for Gymnasium's InvertedDoublePendulum-v5: first on the data of a linear-quadratic regulator
# (experts.py), then on the states that the policy itself reaches.
#
# PYTHON is a Python with spikeserve[imitation], spikeserve-engine and gymnasium[mujoco]; default: python3.
#
# usage: train/recipes/double-pendulum.sh SPIKETRAIN OUT_DIR
set -euo pipefail
usage="usage: $0 SPIKETRAIN OUT_DIR"
spiketrain=${1:?$usage}
out=${2:?$usage}
PYTHONPATH=$(dirname "$0")${PYTHONPATH:+:$PYTHONPATH}
export PYTHONPATH

# One random force moves the cart by 2 m/s, so a longer burst would only show falling pendulums. The observation is the
# whole state, so a short context is enough. No stage reduces the spikes.
"${PYTHON:-python3}" -m spikeserve imitate InvertedDoublePendulum-v5 --expert=experts:balance_double_pendulum \
  --spiketrain="$spiketrain" --out="$out" --hidden-size=64 --train-flags="--slope=4 --context=5" --steps=60000 \
  --longest-burst=1 --burst-rate=0.1 --iterations=1500 --rounds=1 --round-steps=20000 --round-iterations=500 \
  --silence= --selection-episodes=20 --episodes=100
