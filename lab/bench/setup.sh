#!/usr/bin/env bash
# Installs the packages that only the benchmark needs, in addition to deploy/setup.sh: Debian's PyTorch, which is built
# without CUDA, and a Python environment that uses it. Does nothing if everything is installed already.
#
# usage: lab/bench/setup.sh VENV
set -euo pipefail
venv=$(realpath --canonicalize-missing "$1")
cd "$(dirname "$0")"

if ! dpkg-query -W -f='${Status}' python3-torch 2>/dev/null | grep -q '^install ok installed$'; then
  echo "setup: installing python3-torch"
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends python3-torch >/dev/null
fi
if ! cmp -s requirements.txt "$venv/requirements.txt"; then
  echo "setup: making the Python environment of the benchmark in $venv"
  rm -rf "$venv"
  /usr/bin/python3 -m venv --system-site-packages "$venv"
  "$venv/bin/pip" install --quiet --disable-pip-version-check -r requirements.txt
  cp requirements.txt "$venv/requirements.txt"
fi
