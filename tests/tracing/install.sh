#!/usr/bin/env bash
# Builds the collector of manifest.yaml with OpenTelemetry's builder, for test_collector.py, in BUILD_DIR/collector. Does
# nothing if it is there already, or without Go 1.24 (newest_go.sh).
#
# usage: tests/tracing/install.sh BUILD_DIR
set -euo pipefail
source_dir=$(cd "$(dirname "$0")" && pwd)
build_dir=${1:?usage: tests/tracing/install.sh BUILD_DIR}
mkdir -p "$build_dir"
build_dir=$(cd "$build_dir" && pwd)
manifest=$source_dir/manifest.yaml
cmp -s "$manifest" "$build_dir/collector/installed" && exit 0

source "$source_dir/../newest_go.sh"
newest_go "the collector of OpenTelemetry"
version=v$(sed -n 's/^  version: //p' "$manifest")
echo "setup: building OpenTelemetry's collector $version, about three minutes"
cd "$build_dir"
PATH=$(dirname "$go"):$PATH GOTOOLCHAIN=local "$go" run "go.opentelemetry.io/collector/cmd/builder@$version" --config "$manifest" >collector.log 2>&1 ||
  { cat collector.log; exit 1; }
rm collector.log
cp "$manifest" collector/installed
