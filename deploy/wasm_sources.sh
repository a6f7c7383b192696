#!/usr/bin/env bash
# Unpacks Debian's sources of Abseil and Highway into build/wasm-sources, where the preset wasm compiles them for WebAssembly.
# Changes no package source of this machine. Needs the part playground of deploy/setup.sh. Does nothing if they are there.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=build/wasm-sources
[[ ! -e $folder/complete ]] || exit 0

echo "wasm_sources: unpacking into $folder"
rm -rf "$folder"
mkdir -p "$folder/apt/lists/partial" "$folder/apt/parts"
# The machine's sources of packages as sources of source packages, in both of APT's formats.
[[ ! -e /etc/apt/sources.list ]] || sed -n 's/^deb /deb-src /p' /etc/apt/sources.list >"$folder/apt/parts/main.list"
[[ ! -e /etc/apt/sources.list.d/debian.sources ]] ||
  sed 's/^Types:.*/Types: deb-src/' /etc/apt/sources.list.d/debian.sources >"$folder/apt/parts/debian.sources"
options=(-qq -o Dir::Etc::sourcelist=/dev/null -o "Dir::Etc::sourceparts=$PWD/$folder/apt/parts"
  -o "Dir::State::lists=$PWD/$folder/apt/lists" -o APT::Sandbox::User=root)
apt-get "${options[@]}" update
(cd "$folder" && apt-get "${options[@]}" source abseil highway >/dev/null)
for library in abseil highway; do
  mv "$folder/$library"-*/ "$folder/$library"
done
# WebAssembly has no libatomic, and needs none.
patch --quiet --reverse --strip=1 --directory="$folder/abseil" <"$folder/abseil/debian/patches/latomic.diff"
rm -rf "$folder/apt" "$folder"/*.tar.* "$folder"/*.dsc
touch "$folder/complete"
