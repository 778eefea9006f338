#!/bin/sh
# Installs ComVLA into a bare Debian 12, as root. The Dockerfiles call this, and so does
# `make image-check`, which needs no container engine.
#
#   install.sh server|edge SOURCE [WHEELS]
#
# SOURCE is a working copy. WHEELS is a folder of wheels to install from, instead of the package
# index. TORCH_INDEX_URL names a further index for torch: without it pip takes the index's own build,
# which on x86-64 brings CUDA along; PyTorch's installation page gives the address of its CPU builds.
set -eu

image=${1:?usage: install.sh server|edge SOURCE [WHEELS]}
source=${2:?usage: install.sh server|edge SOURCE [WHEELS]}
wheels=${3:-}
case $image in
server) extras=server,images ;;
edge) extras=edge ;;
*) echo "install.sh: expected server or edge, got '$image'" >&2; exit 2 ;;
esac

export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -qq -y --no-install-recommends ca-certificates python3 python3-venv >/dev/null
rm -rf /var/lib/apt/lists/* /var/cache/apt/archives/*

# A fixed number, so that volumes can be given to it and Kubernetes can see that it is not root.
getent passwd comvla >/dev/null ||
    useradd --uid 10001 --user-group --no-create-home --home-dir /nonexistent \
        --shell /usr/sbin/nologin comvla

python3 -m venv /opt/comvla
set -- --quiet --no-cache-dir --disable-pip-version-check --constraint "$source/constraints.txt"
if [ -n "$wheels" ]; then
    set -- "$@" --no-index --find-links "$wheels"
elif [ -n "${TORCH_INDEX_URL:-}" ]; then
    set -- "$@" --extra-index-url "$TORCH_INDEX_URL"
fi
/opt/comvla/bin/python -m pip install "$@" "comvla[$extras] @ file://$source"

# Nothing is compiled or installed in a running container.
site=$(/opt/comvla/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
rm -rf "$site"/torch/include "$site"/torch/share "$site"/torch/test
find "$site"/torch/bin -type f ! -name torch_shm_manager -delete
find "$site" -name "*.a" -delete
/opt/comvla/bin/python -m pip uninstall --quiet --yes pip setuptools wheel 2>/dev/null || true

install -d -o comvla -g comvla /models
install -m 0755 "$source/docker/healthcheck.py" /opt/comvla/bin/comvla-healthcheck
