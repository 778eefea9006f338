#!/usr/bin/env bash
# Renews constraints.txt: resolves every extra for Python 3.10 to 3.13 at once, so that one file
# with markers serves them all. Needs the program `uv` (pip install uv).
#
# NumPy 2.3, SciPy 1.16 and contourpy 1.3.3 are the first that no longer run on Python 3.10; newer
# Pythons get the newest that Python 3.11 can have, so that only two sets are ever in use.
set -euo pipefail
cd "$(dirname "$0")/.."

limits=$(mktemp)
trap 'rm -f "$limits"' EXIT
cat >"$limits" <<'LIMITS'
torch==2.13.*
numpy<2.3; python_version < '3.11'
numpy<2.5; python_version >= '3.11'
scipy<1.16; python_version < '3.11'
scipy<1.18; python_version >= '3.11'
contourpy<1.3.3; python_version < '3.11'
contourpy<1.4; python_version >= '3.11'
LIMITS

{
    sed -n '/^#/p; /^torch==/p' constraints.txt
    # torch's own needs differ between its CPU and accelerator builds, so they stay free.
    uv pip compile pyproject.toml --extra dev --universal --python-version 3.10 \
        --constraint "$limits" --no-header --no-annotate --quiet |
        grep -v -E '^(torch|triton|nvidia-|cuda-|colorama|httpx2-jsfetch)' |
        sed -e "s/ ; platform_.*//" -e "s/\( and\| ;\) sys_platform != 'emscripten'//" \
            -e "s/python_full_version/python_version/" -e "s/ ; /; /"
} >constraints.new
mv constraints.new constraints.txt
