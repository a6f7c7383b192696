#!/usr/bin/env bash
# Trains the shipped CartPole policy: first to play, then, in steps, to play silently. Interrupted, it goes on where
# it was. About fifteen minutes on one core.
#
# usage: train/recipes/cartpole.sh SPIKETRAIN OUT_DIR
set -euo pipefail
usage='usage: train/recipes/cartpole.sh SPIKETRAIN OUT_DIR'
spiketrain=${1:?$usage}
out=${2:?$usage}
# The order of sums depends on the number of threads, and with it the last bits of the weights.
export OMP_NUM_THREADS=1

# stage NAME FLAGS...: trains into OUT_DIR/NAME unless that is finished.
stage() {
  local name=$1
  shift
  if [[ ! -f $out/$name/policy.safetensors ]]; then
    "$spiketrain" train --data="$out/data.cbor" --out="$out/$name" --resume "$@"
  fi
}

mkdir -p "$out"
if [[ ! -f $out/data.cbor ]]; then
  "$spiketrain" dataset --env=CartPole-v1 --seed=0 --steps=10000 --out="$out/data.cbor"
fi
stage 1-play --mode=full --seed=1 --iterations=400
stage 2-quiet --init="$out/1-play/policy.safetensors" --seed=2 --iterations=300 --learning_rate=3e-3 \
  --target_rate=1 --readout_rate=6
stage 3-silent --init="$out/2-quiet/policy.safetensors" --seed=3 --iterations=300 --learning_rate=3e-3 \
  --target_rate=0.3 --readout_rate=3

# Seeds that neither training nor its evaluations saw.
"$spiketrain" eval --policy="$out/3-silent/policy.safetensors" --episodes=1000 --seed=2000000
