#!/bin/sh
# Collects the files of the image: the programs, the libraries that they load, the policies, certificates of authorities,
# and the state of dpkg for these libraries, which scanners for vulnerabilities read.
#
# usage: collect.sh IMAGE_DIR BIN_DIR POLICY_DIR
set -eu
image=$1 programs=$2 policies=$3
mkdir -p "$image/usr/bin" "$image/usr/share/spikeserve" "$image/etc/ssl/certs" "$image/var/lib/dpkg/status.d" \
  "$image/var/lib/spikeserve" "$image/tmp"
for link in bin lib lib64; do ln -s "usr/$link" "$image/$link"; done
chmod 1777 "$image/tmp"
chown 10001:10001 "$image/var/lib/spikeserve"
cp "$programs/spikeserve" "$programs/spikectl" "$image/usr/bin"
cp -R "$policies" "$image/usr/share/spikeserve/policies"
cp /etc/ssl/certs/ca-certificates.crt "$image/etc/ssl/certs"
echo 'spikeserve:x:10001:10001::/var/lib/spikeserve:/nonexistent' >"$image/etc/passwd"
echo 'spikeserve:x:10001:' >"$image/etc/group"
echo 'hosts: files dns' >"$image/etc/nsswitch.conf"
cp /etc/os-release "$image/etc/os-release"

ldd "$image/usr/bin/spikeserve" "$image/usr/bin/spikectl" | grep -o '/[^ ]*\.so[^ ]*' | sort -u | while read -r library; do
  file=$(realpath "$library")
  target=$image/usr/${library#/}
  case $library in /usr/*) target=$image$library ;; esac
  mkdir -p "$(dirname "$target")"
  cp "$file" "$target"
  package=$(dpkg-query -S "$file" "${file#/usr}" 2>/dev/null | head -1 | cut -d: -f1)
  [ -z "$package" ] || dpkg-query -s "$package" >"$image/var/lib/dpkg/status.d/$package"
done
