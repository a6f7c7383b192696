# shellcheck shell=bash
# Sourced by install scripts of programs that build from Go modules.

# newest_go WHAT: sets `go` to the newest Go, Debian's or another one in PATH. Ends the script unless it is Go 1.24 or later,
# which Debian 12 does not have: the tests of WHAT are skipped then.
newest_go() {
  local candidate version
  read -r version go < <(
    for candidate in $(type -ap go) /usr/lib/go/bin/go; do
      [[ ! -x $candidate ]] || echo "$(GOTOOLCHAIN=local "$candidate" env GOVERSION) $candidate"
    done | sort -V | tail -1
    echo
  )
  if [[ $(printf '%s\n' "${version:-go0}" go1.24 | sort -V | head -1) != go1.24 ]]; then
    echo "setup: $1: expected Go 1.24 or later, received ${version:-none}; the tests are skipped"
    exit 0
  fi
}
