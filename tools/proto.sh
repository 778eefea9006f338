#!/usr/bin/env bash
# Regenerates the Python code of the contract with the pinned, old generator.
#
#   tools/proto.sh [--out FOLDER]   (default: beside its source)
set -euo pipefail
cd "$(dirname "$0")/.."

tools/setup.sh proto
.venv-proto/bin/python proto/generate.py "$@"
