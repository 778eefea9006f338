#!/usr/bin/env bash
# Writes the Python code of proto/comvla/v1/policy.proto, with type stubs.
#
#   tools/proto.sh [FOLDER]   (default: proto, so that the generated code lies beside its source)
set -euo pipefail
cd "$(dirname "$0")/.."

out=${1:-proto}
tools/setup.sh proto
"${VENV:-.venv}-proto/bin/python" -m grpc_tools.protoc --proto_path=proto \
    --python_out="$out" --pyi_out="$out" --grpc_python_out="$out" comvla/v1/policy.proto
