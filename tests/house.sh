#!/usr/bin/env bash
# Prints how the house is built, and fails if it gets heavier than was agreed: each line is a measure, its value and the
# most or the least that is allowed.
set -euo pipefail
cd "$(dirname "$0")/.."
failed=0

# at_most LIMIT WHAT VALUE
at_most() {
  printf '%-78s %3d  (at most %d)\n' "$2" "$3" "$1"
  if (($3 > $1)); then
    echo "  FAILED: expected at most $1, received $3" >&2
    failed=1
  fi
}

# at_least LIMIT WHAT VALUE
at_least() {
  printf '%-78s %3d  (at least %d)\n' "$2" "$3" "$1"
  if (($3 < $1)); then
    echo "  FAILED: expected at least $1, received $3" >&2
    failed=1
  fi
}

# count PATTERN FILE...: lines of C++ that match. files PATTERN FOLDER...: files that match.
count() { { grep -hE "$@" || true; } | wc -l; }
files() { { grep -rlE --include='*.h' --include='*.cc' "$@" || true; } | wc -l; }

# structs_with PATTERN FILE...: structs that have a member which matches.
structs_with() {
  awk -v pattern="$1" '
    /^ *(struct|class) [A-Za-z]+[^;]*\{$/ { name = $2; seen = 0 }
    name != "" && !seen && $0 ~ pattern { seen = 1; print name }
    /^ *\};/ { name = "" }' "${@:2}" | wc -l
}

# beats.h describes what a robot did by itself, which is no Act.
mapfile -t headers < <(git ls-files 'core/*.h' 'server/*.h' ':!core/agent/beats.h')

# One request is one object, and one gate leads it.
at_most 4 'files of server/ that know how a session is claimed and awaited' \
  "$(files 'may_claim|WhenDurable|Recover\(' server)"
at_most 0 'files of server/ with a handler that is invoked by its form' "$(files '\bMessagesOf\b|\bInvoke\(' server)"
at_most 0 'methods of handlers without a CallContext' \
  "$(count '^  absl::Status [A-Z][A-Za-z]*\(const (v1|inference)::' server/*/*_handler.h)"
at_most 3 'structs that one Act is packed into' \
  "$(structs_with '^ +(const )?(v1::ActRequest[*]|absl::Span<const float>|std::shared_ptr<ActMessages>) (request|messages|observation|tokens)[ ;=]' "${headers[@]}")"
at_most 1 'functions named ActTogether' "$(count '\bActTogether\(' "${headers[@]}")"
at_most 1 'types named ActCall' "$(count '(struct|class) ActCall\b' "${headers[@]}")"
at_most 1 'functions named IsAhead' "$(count '\bIsAhead\(' "${headers[@]}")"

# What the contract says about a method is written in the contract: a method of operators is its .proto, two files of its
# handler, and the line that connects them.
for method in PauseLearning PromoteHead ListHistory RollbackHead; do
  at_most 4 "files of the contract, the server and the clients that name $method" \
    "$(git grep -lw "$method" -- proto server client/include client/src client/python ':!proto/releases' | wc -l)"
done

# What headers require is checked. Neither the checks' own room counts nor their tests.
mapfile -t sources < <(git ls-files '*.h' '*.cc' ':!core/contract' ':!tests')
at_least 100 'checks of what headers require' "$(count '\bSPIKESERVE_DCHECK(_[A-Z]{2})?\(' "${sources[@]}")"
at_least 30 'checks that a method runs on the thread of its loop' "$(count '\bAssertCurrent\(\);' "${sources[@]}")"

# The client library stands alone, without core, and has no macros.
mapfile -t product < <(git ls-files '*.cc' ':!tests' ':!client/src')
at_most 80 'early returns of a status without a macro' \
  "$(count '^ *if \(!(\w+)\.ok\(\)\) return \1(\.status\(\))?;' "${product[@]}")"

# Rooms of one subject. These two need more files for theirs.
largest=$(git ls-files '*.h' '*.cc' ':!tests' | sed -E 's,/[^/]+$,,' |
  grep -vE '^(server/transport|client/spikectl)$' | sort | uniq -c | sort -rn | head -1)
at_most 25 "files of the largest room, ${largest##* }" "$(awk '{ print $1 }' <<<"$largest")"
session=core/agent/agent_session.h
at_most 9 'fields of AgentSession' \
  "$(awk '/^ private:/ { inside = 1 } /^};/ { inside = 0 } inside' $session | count '^  [^/(]*[a-z]_( = .*)?;' -)"
at_most 139 'lines of its header' "$(wc -l <$session)"
at_most 500 'lines of its source' "$(wc -l <core/agent/agent_session.cc)"
at_most 0 'friends in the stores of the server' "$(count '^ *friend (class|struct) ' server/store/* server/heads/*)"

exit "$failed"
