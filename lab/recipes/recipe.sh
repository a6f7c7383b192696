# shellcheck shell=bash disable=SC2154 # environment
# Functions for the recipes, which source this file. A recipe is called with SPIKETRAIN and OUT_DIR and sets
# `environment`. A recipe that was interrupted continues when it is run again. With a third argument, a number from 1 on,
# it draws other random numbers: seed 3 of run 2 is 203.
set -euo pipefail
usage="usage: $0 SPIKETRAIN OUT_DIR [RUN]"
spiketrain=${1:?$usage}
out=${2:?$usage}
run=${3:+${3}0}
mkdir -p "$out"

# data NAME FLAGS...: records OUT_DIR/NAME.cbor unless the file exists.
data() {
  local name=$1
  shift
  if [[ ! -f $out/$name.cbor ]]; then
    "$spiketrain" dataset --env="$environment" --seed="${run}0" --out="$out/$name.cbor" "${@/#--seed=/--seed=$run}"
  fi
}

# stage NAME DATA,... FLAGS...: trains on the files OUT_DIR/DATA.cbor and writes to OUT_DIR/NAME, unless that stage is
# finished. Starts from the policy of the previous stage, if there is one, and sets `policy` to the path of its own.
stage() {
  local name=$1 data=$out/${2//,/.cbor,$out/}.cbor
  shift 2
  if [[ ! -f $out/$name/policy.safetensors ]]; then
    "$spiketrain" train --data="$data" --out="$out/$name" --resume ${policy:+--init="$policy"} \
      "${@/#--seed=/--seed=$run}"
  fi
  policy=$out/$name/policy.safetensors
}

# Evaluates the last stage's policy on seeds that were used neither in training nor in its evaluations.
unseen() {
  "$spiketrain" eval --policy="$policy" --episodes=1000 --seed=2000000
}

# integer FLAGS...: writes the last stage's policy in integer arithmetic to OUT_DIR/integer, without the hidden neurons that
# never fire, and compares both on the same starts as above. A mode leaves out parts that the policy can do without.
integer() {
  "$spiketrain" quantize --to=integer --prune "$@" --policy="$policy" --out="$out/integer/policy.safetensors"
}

# dial RETURN...: evaluates the last stage's policy with each target return, on seeds that were not used before.
dial() {
  local returns=$*
  "$spiketrain" eval --policy="$policy" --episodes=100 --seed=2000000 --target_returns="${returns// /,}"
}
