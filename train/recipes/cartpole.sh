#!/usr/bin/env bash
# Trains the shipped CartPole policy: first to play, then, in steps, to play silently. Interrupted, it goes on where
# it was. About twenty minutes on one core.
#
# usage: train/recipes/cartpole.sh SPIKETRAIN OUT_DIR
set -euo pipefail
usage='usage: train/recipes/cartpole.sh SPIKETRAIN OUT_DIR'
spiketrain=${1:?$usage}
out=${2:?$usage}
# The order of sums depends on the number of threads, and with it the last bits of the weights.
export OMP_NUM_THREADS=1

# stage NAME DATA FLAGS...: trains on OUT_DIR/DATA.cbor into OUT_DIR/NAME unless that is finished.
stage() {
  local name=$1 data=$2
  shift 2
  if [[ ! -f $out/$name/policy.safetensors ]]; then
    "$spiketrain" train --data="$out/$data.cbor" --out="$out/$name" --resume "$@"
  fi
}

# data NAME FLAGS...: records OUT_DIR/NAME.cbor unless it is there.
data() {
  local name=$1
  shift
  if [[ ! -f $out/$name.cbor ]]; then
    "$spiketrain" dataset --env=CartPole-v1 --seed=0 --out="$out/$name.cbor" "$@"
  fi
}

mkdir -p "$out"
# The paper's 10,000 steps are enough to learn to play. A quiet policy is imprecise, and needs more starts to learn from:
# near them random steps are so frequent that in the end they drown the expert's, so the last two stages do without.
data small --steps=10000
data large --steps=100000
data expert --steps=100000 --expert_fraction=1

stage 1-play small --mode=full --seed=1 --iterations=400
stage 2-quiet large --init="$out/1-play/policy.safetensors" --seed=2 --iterations=400 --learning_rate=2e-3 \
  --target_rate=1 --readout_rate=6
stage 3-quieter large --init="$out/2-quiet/policy.safetensors" --seed=3 --iterations=400 --learning_rate=2e-3 \
  --target_rate=0.3 --readout_rate=3
stage 4-silent expert --init="$out/3-quieter/policy.safetensors" --seed=4 --iterations=300 --learning_rate=2e-3 \
  --target_rate=0.2 --readout_rate=2.5
stage 5-settled expert --init="$out/4-silent/policy.safetensors" --seed=5 --iterations=300 --learning_rate=1.5e-3 \
  --target_rate=0.2 --readout_rate=2.5

# Seeds that neither training nor its evaluations saw.
"$spiketrain" eval --policy="$out/5-settled/policy.safetensors" --episodes=1000 --seed=2000000
