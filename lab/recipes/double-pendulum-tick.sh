#!/usr/bin/env bash
# Trains a policy for Gymnasium's InvertedDoublePendulum-v5 (package gymnasium[mujoco]) with a single tick, in mode baseline.
#
# usage: lab/recipes/double-pendulum-tick.sh SPIKETRAIN OUT_DIR
source "$(dirname "$0")/imitation.sh"

# As in double-pendulum.sh, but with more iterations, and with a step to silence.
imitate InvertedDoublePendulum-v5 --expert=experts:balance_double_pendulum --ticks=1 --action-noise=0 \
  --learning-rate=0.002 --longest-burst=1 --burst-rate=0.2 --iterations=4000 --rounds=4 --round-steps=30000 --round-iterations=3000 \
  --round-disturbed=0.5 --silence=20:80 --silence-iterations=4000 --selection-episodes=100 --episodes=100
# Rounding alone lost one start of a hundred.
train_integer --seed=9 --iterations=3000 --clip_steps=5 --batch=64 --slope=4 --learning_rate=1e-3 --warmup=10 --target_rate=8 \
  --readout_rate=50 --operation_penalty=0.02
