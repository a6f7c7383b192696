#!/usr/bin/env bash
# Installs snnTorch, NeuroBench and NIR for the tests of docs/design/chips.md, in an environment that uses Debian's PyTorch.
# Does nothing if they are there already.
#
# usage: tests/chips/install.sh BUILD_DIR
set -euo pipefail
build_dir=${1:?usage: tests/chips/install.sh BUILD_DIR}/chips
requirements=$(dirname "$0")/requirements.txt
if ! cmp -s "$requirements" "$build_dir/requirements.txt"; then
  echo "setup: installing snnTorch, NeuroBench and NIR in $build_dir"
  rm -rf "$build_dir"
  /usr/bin/python3 -m venv --system-site-packages "$build_dir/venv"
  "$build_dir/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps -r "$requirements"
  cp "$requirements" "$build_dir/requirements.txt"
fi
