#!/usr/bin/env bash
# Installs the packages that building, testing and training need on a bare Debian 12, and creates the Python environment
# of the tests. Run it as root. Does nothing if everything is installed.
#
# usage: deploy/setup.sh [BUILD_DIR]
set -euo pipefail
cd "$(dirname "$0")/.."
build_dir=${1:-build}

packages=(
  # toolchain
  g++ make cmake ninja-build ccache git clang libclang-rt-14-dev clang-format clang-tidy pkg-config
  # server, client, core
  libgrpc++-dev protobuf-compiler protobuf-compiler-grpc libprotobuf-dev libabsl-dev
  prometheus-cpp-dev libboost1.74-dev libspdlog-dev libhwy-dev nlohmann-json3-dev zlib1g-dev libcli11-dev
  libeigen3-dev libnghttp2-dev liblmdb-dev libhiredis-dev dpkg-dev file
  # the Python engine
  python3-dev
  # training only
  libtorch-dev libopenblas-dev libhdf5-dev
  # tests, demo
  libgtest-dev libgmock-dev prometheus redis-server spin iproute2 ca-certificates curl python3 python3-venv chromium chromium-driver
  mandoc zsh fish user-mode-linux e2fsprogs
  # tests of exported populations: Debian's PyTorch, which has no CUDA
  python3-torch
  # interop: clients in other languages, and proxies
  golang-go haproxy nghttp2-client nginx
)
# Other sources of Node.js bring npm along, and conflict with Debian's.
command -v npm >/dev/null || packages+=(nodejs npm)

missing=()
for package in "${packages[@]}"; do
  dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q '^install ok installed$' || missing+=("$package")
done
if ((${#missing[@]})); then
  echo "setup: installing ${missing[*]}"
  export DEBIAN_FRONTEND=noninteractive
  apt-get update -qq
  # The tests need the programs prometheus, redis-server, haproxy and nginx. This policy keeps the packages from
  # starting services.
  printf '#!/bin/sh\nexit 101\n' >/tmp/policy-rc.d.$$
  if [[ ! -e /usr/sbin/policy-rc.d ]]; then
    install -m 755 /tmp/policy-rc.d.$$ /usr/sbin/policy-rc.d
    trap 'rm -f /usr/sbin/policy-rc.d' EXIT
  fi
  rm -f /tmp/policy-rc.d.$$
  apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
fi

requirements=tests/python/requirements.txt
venv=$build_dir/venv
if ! cmp -s "$requirements" "$venv/requirements.txt"; then
  echo "setup: creating the Python environment of the tests in $venv"
  rm -rf "$venv"
  mkdir -p "$build_dir"
  /usr/bin/python3 -m venv "$venv"
  "$venv/bin/pip" install --quiet --disable-pip-version-check -r "$requirements"
  cp "$requirements" "$venv/requirements.txt"
fi

tests/chips/install.sh "$build_dir"
tests/interop/install.sh "$build_dir"
