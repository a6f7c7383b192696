#!/usr/bin/env bash
# Installs on a bare Debian 12 or 13 what a target of the Makefile needs, and nothing that is there already. Run it as root.
#
# usage: deploy/setup.sh [BUILD_DIR [PART...]]   default: build and the usual parts
#
# | part    | what it installs                                                                                    |
# | server  | compiler and libraries of spikeserve, spikectl and spikeload                                        |
# | build   | libraries of the tests and the training, and the Python environment of the tests, BUILD_DIR/venv    |
# | clang   | clang and its tools, for the presets checked and fuzz, and for `make format`                        |
# | tests   | programs that tests run: Redis, Prometheus, shells                                                |
# | full    | programs that only `make test-all` runs: a browser, proxies, Go, Rust, a virtual machine            |
# | chips   | snnTorch, NeuroBench and NIR, in BUILD_DIR/chips                                                    |
# | hubs    | libraries of Hugging Face, OCI and S3, with local ones of these, in BUILD_DIR/hubs                 |
# | interop | clients of gRPC in other languages, in BUILD_DIR/interop                                            |
# | arm64   | cross compiler, emulator, and what makes the arm64 libraries of deploy/arm64_root.sh                |
# | release | checks of packages, images, charts and pages: lintian, buildah, and BUILD_DIR/release-tools/venv    |
# | chart   | helm and kube-apiserver, for slow tests of the chart, in BUILD_DIR/kubernetes; only when named      |
# | collector | a collector of OpenTelemetry, for a slow test of traces, in BUILD_DIR/collector; only when named |
# | ros     | rclpy from wheels for Python 3.11, for slow tests of the node, in BUILD_DIR/ros; only when named    |
# | microcontrollers | compilers and emulators of Cortex-M and RISC-V, for `make test-chips`; only when named  |
# | playground | Emscripten, for `make playground`; only when named                                              |
set -euo pipefail
cd "$(dirname "$0")/.."
build_dir=${1:-build}
shift || true
usual_parts=(server build clang tests full chips hubs interop arm64 release)
all_parts=("${usual_parts[@]}" chart collector ros microcontrollers playground)

packages_server=(
  g++ make cmake ninja-build ccache git pkg-config ca-certificates
  libgrpc++-dev protobuf-compiler protobuf-compiler-grpc libprotobuf-dev libabsl-dev
  prometheus-cpp-dev libboost-dev libspdlog-dev libhwy-dev nlohmann-json3-dev zlib1g-dev libcli11-dev
  libeigen3-dev libnghttp2-dev liblmdb-dev libhiredis-dev
  curl  # deploy/demo.sh reads the metrics
)
packages_build=(
  libgtest-dev libgmock-dev python3 python3-dev python3-venv
  libtorch-dev libopenblas-dev libhdf5-dev  # training
  dpkg-dev file  # packages
)
packages_clang=(clang libclang-rt-dev clang-format clang-tidy)
packages_tests=(prometheus redis-server mandoc zsh fish lmdb-utils iproute2)
packages_full=(haproxy nghttp2-client nginx chromium chromium-driver golang-go rustc cargo user-mode-linux e2fsprogs spin)
packages_chips=(python3-torch)  # Debian's PyTorch, which has no CUDA
packages_hubs=(docker-registry)
packages_interop=(golang-go)
packages_arm64=(g++-aarch64-linux-gnu qemu-user-static mmdebstrap)
packages_release=(lintian debootstrap buildah uidmap qemu-user-static etcd-server golang-go)
packages_chart=(etcd-server golang-go)
packages_collector=(golang-go)
packages_ros=(python3 python3-venv)
packages_microcontrollers=(
  gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm gcc-riscv64-unknown-elf picolibc-riscv64-unknown-elf qemu-system-misc
  # Processors of 32 bits and of the other byte order. gcc-multilib is not installable beside cross compilers.
  gcc-i686-linux-gnu libc6-dev-i386-cross gcc-powerpc-linux-gnu libc6-dev-powerpc-cross qemu-user-static
  python3-venv  # the page "On a microcontroller" makes an environment
)
packages_playground=(emscripten cmake ninja-build ccache dpkg-dev libeigen3-dev nlohmann-json3-dev)
# Other sources of Node.js bring npm along, and conflict with Debian's.
command -v npm >/dev/null || packages_interop+=(nodejs npm)

# Installs the Debian packages "$@" that are missing.
install_packages() {
  local package missing=()
  for package in "$@"; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q '^install ok installed$' || missing+=("$package")
  done
  ((${#missing[@]})) || return 0
  echo "setup: installing ${missing[*]}"
  export DEBIAN_FRONTEND=noninteractive
  apt-get update -qq
  # The tests need the programs prometheus, redis-server, haproxy and nginx. This policy keeps the packages from
  # starting services.
  if [[ ! -e /usr/sbin/policy-rc.d ]]; then
    printf '#!/bin/sh\nexit 101\n' >/tmp/policy-rc.d.$$
    install -m 755 /tmp/policy-rc.d.$$ /usr/sbin/policy-rc.d
    rm -f /tmp/policy-rc.d.$$
    trap 'rm -f /usr/sbin/policy-rc.d' EXIT
  fi
  apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

# Creates the Python environment $1 from the requirements $2.
install_venv() {
  local venv=$1 requirements=$2
  cmp -s "$requirements" "$venv/requirements.txt" && return 0
  echo "setup: creating the Python environment $venv"
  rm -rf "$venv"
  mkdir -p "$(dirname "$venv")"
  /usr/bin/python3 -m venv "$venv"
  "$venv/bin/pip" install --quiet --disable-pip-version-check -r "$requirements"
  cp "$requirements" "$venv/requirements.txt"
}

(($#)) || set -- "${usual_parts[@]}"
packages=()
for part in "$@"; do
  declare -p "packages_$part" >/dev/null 2>&1 || {
    echo "setup: part: expected ${all_parts[*]}, received $part" >&2
    exit 1
  }
  declare -n of_part=packages_$part
  packages+=("${of_part[@]}")
done
install_packages "${packages[@]}"
for part in "$@"; do
  case $part in
    build) install_venv "$build_dir/venv" tests/python/requirements.txt ;;
    chips) tests/chips/install.sh "$build_dir" ;;
    release) install_venv "$build_dir/release-tools/venv" deploy/release/requirements.txt ;;
    hubs) install_venv "$build_dir/hubs/venv" tests/hubs/requirements.txt ;;
    interop) tests/interop/install.sh "$build_dir" ;;
    chart) tests/kubernetes/install.sh "$build_dir" ;;
    collector) tests/tracing/install.sh "$build_dir" ;;
    ros) install_venv "$build_dir/ros/venv" tests/ros/requirements.txt ;;
  esac
done
