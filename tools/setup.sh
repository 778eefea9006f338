#!/usr/bin/env bash
# Sets up a working copy: a virtual environment with the package installed editable, and the few
# system packages that simulation and tests need. Run again, it finishes at once unless
# pyproject.toml, constraints.txt or the Python version changed.
#
#   tools/setup.sh sim     what `make demo` and `make bench` need
#   tools/setup.sh dev     sim, and what `make test` and `make lint` need
#   tools/setup.sh image   what `make image-check` needs besides dev
#   tools/setup.sh proto   the old protobuf generator, in an environment of its own
#
# Variables: PYTHON (default python3) makes the environment, VENV (default .venv) is where it goes.
set -euo pipefail
cd "$(dirname "$0")/.."

extra=${1:?usage: tools/setup.sh sim|dev|image|proto}
python=${PYTHON:-python3}
venv=${VENV:-.venv}

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }

# ---- Python ---------------------------------------------------------------------------------

make_environment() { # folder
    if [ -x "$1/bin/python" ]; then return; fi
    command -v "$python" >/dev/null ||
        die "found no '$python'; name a Python 3.10 to 3.13, e.g.: make PYTHON=python3.11 demo"
    "$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' ||
        die "expected Python 3.10 to 3.13, '$python' is $("$python" -V 2>&1);" \
            "name another, e.g.: make PYTHON=python3.11 demo"
    say "creating $1 with $("$python" -V 2>&1)"
    "$python" -m venv "$1" 2>/dev/null ||
        die "'$python -m venv' failed; on Debian and Ubuntu type: sudo apt-get install python3-venv"
}

# What an installation depends on, as one hash: equal hashes mean that there is nothing to do.
state_of() { # environment, files...
    local environment=$1; shift
    { "$environment/bin/python" -V; cat "$@"; pwd; } | "$environment/bin/python" -c \
        'import hashlib, sys; print(hashlib.sha256(sys.stdin.buffer.read()).hexdigest())'
}

install_into() { # environment, stamp name, state, pip arguments...
    local environment=$1 stamp=$1/.comvla-$2 state=$3; shift 3
    if [ "$(cat "$stamp" 2>/dev/null)" = "$state" ]; then return; fi
    say "installing into $environment (minutes the first time)"
    "$environment/bin/python" -m pip install -qq --disable-pip-version-check "$@"
    echo "$state" >"$stamp"
}

install_package() { # extra
    make_environment "$venv"
    local state
    state=$(state_of "$venv" pyproject.toml constraints.txt)
    # The extra "dev" contains "sim".
    if [ "$(cat "$venv/.comvla-dev" 2>/dev/null)" = "$state" ]; then return; fi
    install_into "$venv" "$1" "$state" --constraint constraints.txt --editable ".[$1]"
}

# ---- System packages ------------------------------------------------------------------------

as_root=
may_install() {
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" = 0 ]; then return 0; fi
    as_root="sudo -n"
    sudo -n true 2>/dev/null
}

apt_install() { # package
    say "installing the system package $1"
    $as_root apt-get -qq update &&
        $as_root env DEBIAN_FRONTEND=noninteractive \
            apt-get -qq install -y --no-install-recommends "$1" >/dev/null
}

has_library() { # library name without lib and .so
    "$venv/bin/python" - "$1" <<'PYTHON'
import ctypes.util
import sys

sys.exit(ctypes.util.find_library(sys.argv[1]) is None)
PYTHON
}

# MuJoCo renders off-screen through OSMesa (any machine) or EGL.
need_gl() {
    if has_library OSMesa; then return; fi
    if may_install && apt_install libosmesa6; then return; fi
    say "rendering without a screen works best with OSMesa; type: sudo apt-get install libosmesa6"
    has_library EGL || die "found neither OSMesa nor EGL, and the simulator needs one of them"
    say "going on with EGL"
}

# One test lets a real Prometheus scrape the server.
need_prometheus() {
    if command -v prometheus >/dev/null; then return; fi
    if may_install && apt_install prometheus; then
        # Only the program is wanted: do not leave a service behind that nobody asked for.
        if [ -d /run/systemd/system ]; then
            $as_root systemctl disable --quiet --now prometheus || true
        fi
        return
    fi
    say "the test with a real Prometheus will be skipped; to run it type:" \
        "sudo apt-get install prometheus"
}

# Another asks a made-up modem over a real message bus.
need_dbus() {
    if command -v dbus-daemon >/dev/null; then return; fi
    # The daemon alone, without the system bus that the package "dbus" starts.
    if may_install && apt_install dbus-daemon; then return; fi
    say "the tests with a real D-Bus will be skipped; to run them type:" \
        "sudo apt-get install dbus-daemon"
}

# Others look at the page of the fleet in a real browser.
need_chromium() {
    local name
    for name in chromium chromium-browser google-chrome google-chrome-stable; do
        if command -v "$name" >/dev/null; then return; fi
    done
    # Ubuntu's package of that name is a snap, which a container cannot run.
    if ! grep -qs '^ID=ubuntu' /etc/os-release && may_install && apt_install chromium; then return; fi
    say "the tests in a real browser will be skipped; to run them install chromium"
}

# ---- What was asked for ---------------------------------------------------------------------

case $extra in
sim)
    install_package sim
    need_gl
    ;;
dev)
    install_package dev
    need_gl
    need_prometheus
    need_dbus
    need_chromium
    ;;
proto)
    # Always here, because the test that regenerates the code looks for it here.
    make_environment .venv-proto
    install_into .venv-proto proto "$(state_of .venv-proto tools/proto-requirements.txt)" \
        --requirement tools/proto-requirements.txt
    ;;
image)
    if ! command -v debootstrap >/dev/null; then
        { may_install && apt_install debootstrap; } ||
            die "image-check needs debootstrap; type: sudo apt-get install debootstrap"
    fi
    ;;
*) die "expected sim, dev, image or proto, got '$extra'" ;;
esac
