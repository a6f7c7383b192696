#!/usr/bin/env bash
# Fails if the subject of a commit message is empty or longer than 72 characters, after which `git log --oneline` and
# web pages cut it.
#
# usage: tests/check_subject.sh MESSAGE_FILE
set -euo pipefail
subject=$(grep -v '^#' "$1" | head -1)
length=$(printf %s "$subject" | LC_ALL=C.UTF-8 wc -m)
((length >= 1 && length <= 72)) || {
  echo "subject: expected 1 to 72 characters, received $length: $subject" >&2
  exit 1
}
