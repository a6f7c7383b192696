# What the recipes share; sourced, not run. A recipe is called with SPIKETRAIN and OUT_DIR and sets `environment`;
# interrupted, it goes on where it was.
set -euo pipefail
usage="usage: $0 SPIKETRAIN OUT_DIR"
spiketrain=${1:?$usage}
out=${2:?$usage}
# The order of sums depends on the number of threads, and with it the last bits of the weights.
export OMP_NUM_THREADS=1
mkdir -p "$out"

# data NAME FLAGS...: records OUT_DIR/NAME.cbor unless it is there.
data() {
  local name=$1
  shift
  if [[ ! -f $out/$name.cbor ]]; then
    "$spiketrain" dataset --env="$environment" --seed=0 --out="$out/$name.cbor" "$@"
  fi
}

# stage NAME DATA FLAGS...: trains on OUT_DIR/DATA.cbor into OUT_DIR/NAME unless that is finished, going on from the
# stage before, if there is one. Leaves its policy in `policy`.
stage() {
  local name=$1 data=$2
  shift 2
  if [[ ! -f $out/$name/policy.safetensors ]]; then
    "$spiketrain" train --data="$out/$data.cbor" --out="$out/$name" --resume ${policy:+--init="$policy"} "$@"
  fi
  policy=$out/$name/policy.safetensors
}

# Plays the last stage's policy from seeds that neither training nor its evaluations saw.
unseen() {
  "$spiketrain" eval --policy="$policy" --episodes=1000 --seed=2000000
}

# dial RETURN...: asks the last stage's policy for each return, from seeds that nothing saw before.
dial() {
  local returns=$*
  "$spiketrain" eval --policy="$policy" --episodes=100 --seed=2000000 --target_returns="${returns// /,}"
}
