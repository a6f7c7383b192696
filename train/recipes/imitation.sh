# A function for the recipes that run `spikeserve imitate`, which source this file. A recipe is called with SPIKETRAIN and
# OUT_DIR. A recipe that was interrupted continues when it is run again.
#
# PYTHON is a Python with spikeserve[imitation], spikeserve-engine and the package of the environment; default: python3.
set -euo pipefail
usage="usage: $0 SPIKETRAIN OUT_DIR"
spiketrain=${1:?$usage}
out=${2:?$usage}
# The experts are beside this file.
PYTHONPATH=$(dirname "$0")${PYTHONPATH:+:$PYTHONPATH}
export PYTHONPATH

# imitate ENVIRONMENT FLAGS...: runs `python -m spikeserve imitate` into OUT_DIR.
imitate() {
  "${PYTHON:-python3}" -m spikeserve imitate "$@" --spiketrain="$spiketrain" --out="$out"
}
