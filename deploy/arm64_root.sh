#!/usr/bin/env bash
# Makes a folder with the arm64 libraries that `cmake --preset arm64` links and qemu runs, from this machine's Debian
# release. Changes no package of this machine. Needs the part arm64 of deploy/setup.sh. Run it as root. Does nothing if the
# folder is complete.
#
# usage: deploy/arm64_root.sh [--without-training]   --without-training leaves out libtorch, two thirds of the folder
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD/build/arm64-root

# The libraries of deploy/setup.sh, and what installed packages need: a shell, dpkg, adduser.
libraries=(
  libc6-dev libgrpc++-dev protobuf-compiler-grpc libprotobuf-dev libabsl-dev prometheus-cpp-dev libboost-dev libspdlog-dev
  libhwy-dev nlohmann-json3-dev zlib1g-dev libcli11-dev libeigen3-dev libnghttp2-dev liblmdb-dev libhiredis-dev
  python3-dev libgtest-dev libgmock-dev adduser
)
training=(libtorch-dev libopenblas-dev libhdf5-dev)

# shellcheck source=/dev/null
. /etc/os-release
marker="$VERSION_CODENAME ${libraries[*]}"
present=$(cat "$root/etc/arm64-root" 2>/dev/null || true)
[[ $present != "$marker ${training[*]}" ]] || exit 0
if [[ ${1:-} == --without-training ]]; then
  [[ $present != "$marker" ]] || exit 0
else
  libraries+=("${training[@]}")
fi

echo "arm64_root: making $root"
rm -rf "$root"
mkdir -p "$(dirname "$root")"
# The packages are extracted and not configured, so that nothing has to run on an arm64 processor.
list=$(IFS=,; echo "libstdc++-$(aarch64-linux-gnu-g++ -dumpversion)-dev,${libraries[*]}")
mmdebstrap --quiet --mode=root --variant=extract --architectures=arm64 --skip=check/qemu,download/cleanup,cleanup/apt \
  --include="$list" --aptopt='APT::Keep-Downloaded-Packages "true"' \
  --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
  "$VERSION_CODENAME" "$root"

# Writes package data for dpkg-shlibdeps, from which cpack learns which packages the built programs need. It has the paths of
# this machine, because dpkg-shlibdeps looks for the packages of the files that it finds.
data=$root/var/lib/shlibdeps
mkdir -p "$data/info" "$data/updates"
echo 1 >"$data/info/format"  # names of files have the architecture
for package in "$root"/var/cache/apt/archives/*.deb; do
  name=$(dpkg-deb --field "$package" Package)
  [[ $(dpkg-deb --field "$package" Multi-Arch) != same ]] || name+=:arm64
  dpkg-deb --control "$package" "$root/control"
  { sed 's/^Package: .*/&\nStatus: install ok installed/' "$root/control/control"; echo; } >>"$data/status"
  dpkg-deb --fsys-tarfile "$package" | tar --list | sed "s,^\.,$root,; s,/\$,," >"$data/info/$name.list"
  for file in shlibs symbols; do
    [[ ! -e $root/control/$file ]] || cp "$root/control/$file" "$data/info/$name.$file"
  done
  rm -r "$root/control"
done
rm -f "$root"/var/cache/apt/archives/*.deb

# The links that the packages for training make with update-alternatives when they are configured.
alternatives=$root/usr/lib/aarch64-linux-gnu
for library in "$alternatives"/openblas-pthread/lib*.so*; do
  [[ ! -e $library ]] || ln -sfr "$library" "$alternatives"
done
[[ ! -e $alternatives/pkgconfig/hdf5-serial.pc ]] || ln -sf hdf5-serial.pc "$alternatives/pkgconfig/hdf5.pc"

# Links to absolute paths, such as that of zlib, would leave the root.
while read -r link; do
  target=$(readlink "$link")
  [[ ! -e $root$target ]] || ln -sfrT "$root$target" "$link"
done < <(find "$root/usr" "$root/etc" -lname '/*')
echo "$VERSION_CODENAME ${libraries[*]}" >"$root/etc/arm64-root"
