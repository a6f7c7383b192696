# shellcheck shell=bash
# Functions for the recipes that run `spikeserve imitate`, which source this file. A recipe is called with SPIKETRAIN and
# OUT_DIR. A recipe that was interrupted continues when it is run again.
#
# PYTHON is a Python with spikeserve-train[imitation], spikeserve-engine and the package of the environment; default: python3.
set -euo pipefail
usage="usage: $0 SPIKETRAIN OUT_DIR"
spiketrain=${1:?$usage}
out=${2:?$usage}
# The experts are beside this file.
PYTHONPATH=$(dirname "$0")${PYTHONPATH:+:$PYTHONPATH}
export PYTHONPATH

# What the recipes do not say themselves. `imitate` alone would choose most of it by the environment and the data.
settings=(--steps=60000 --burst-rate=0.3 --longest-burst=8 --held-bursts=0 --context=5 --clip-steps=5 --action-noise=0.5
  --learning-rate=0.003 --iterations=1500 --rounds=4 --round-disturbed=0 --round-steps=30000 --round-iterations=800
  --silence-iterations=500 --tolerance=0.02)

# imitate ENVIRONMENT FLAGS...: runs `python -m spikeserve imitate` into OUT_DIR.
imitate() {
  task=("$1")
  local flag
  for flag in "${@:2}"; do
    if [[ $flag == --wrapper=* ]]; then task+=("$flag"); fi
  done
  "${PYTHON:-python3}" -m spikeserve imitate "$1" "${settings[@]}" "${@:2}" --spiketrain="$spiketrain" --out="$out"
}

# integer FLAGS...: adds version 3 to OUT_DIR/policies, in integer arithmetic. FLAGS are those of `spiketrain quantize`.
integer() {
  "${PYTHON:-python3}" "$(dirname "$0")/integer_version.py" "${task[@]}" --out="$out" --spiketrain="$spiketrain" \
    --flags="$*"
}

# train_integer FLAGS...: the same, trained through the integers. FLAGS are those of `spiketrain train`.
train_integer() {
  "${PYTHON:-python3}" "$(dirname "$0")/integer_version.py" "${task[@]}" --out="$out" --spiketrain="$spiketrain" \
    --train="$*"
}
