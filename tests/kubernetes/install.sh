#!/usr/bin/env bash
# Builds helm and kube-apiserver, at the versions that helm/go.mod and apiserver/go.mod pin, for the slow tests of the chart.
# Does nothing for those that are there already, or without Go 1.24 (newest_go.sh).
#
# usage: tests/kubernetes/install.sh BUILD_DIR
set -euo pipefail
source_dir=$(cd "$(dirname "$0")" && pwd)
build_dir=${1:?usage: tests/kubernetes/install.sh BUILD_DIR}/kubernetes
mkdir -p "$build_dir"
build_dir=$(cd "$build_dir" && pwd)

source "$source_dir/../newest_go.sh"
newest_go "helm and kube-apiserver"

# build NAME PACKAGE [LINKER_FLAGS]: builds the program NAME from the module in the folder NAME.
build() {
  local module=$source_dir/${1#kube-}
  cmp -s <(cat "$module"/go.{mod,sum}) "$build_dir/$1.installed" && return 0
  echo "setup: building $1, about five minutes"
  (cd "$module" && "$go" build -mod=readonly -ldflags="-s -w ${3:-}" -o "$build_dir/bin/$1" "$2")
  cat "$module"/go.{mod,sum} >"$build_dir/$1.installed"
}

build helm helm.sh/helm/v3/cmd/helm
# It tells its version to helm, which compares it with the chart's.
kubernetes=$(sed -n 's#^require k8s.io/kubernetes ##p' "$source_dir/apiserver/go.mod")
build kube-apiserver k8s.io/kubernetes/cmd/kube-apiserver "-X k8s.io/component-base/version.gitVersion=$kubernetes"
