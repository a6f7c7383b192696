#!/usr/bin/env bash
# Fails if clang-format would change a file.
set -euo pipefail
cd "$(dirname "$0")/.."
git ls-files -z --cached --others --exclude-standard '*.h' '*.cc' | xargs -0 clang-format --dry-run -Werror
