#!/usr/bin/env bash
# Makes .venv with all that `make demo` and `make test` need; returns at once where that is already done.
# With `packages`, all but the compiled kernels.
set -euo pipefail
cd "$(dirname "$0")/.."

# Open3D loads the first five on import; PyVista draws off-screen through EGL, Open3D through Vulkan, both with Mesa's
# software renderers.
debian_packages=(libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1 libegl-mesa0 libgl1-mesa-dri libvulkan1 mesa-vulkan-drivers)
supported_python='import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))'
packages_stamp=.venv/og-pointcloud-packages
kernels_stamp=.venv/og-pointcloud-kernels

say() { echo "setup: $*" >&2; }

stop() {
    say "$*"
    exit 1
}

find_python() {
    local candidate
    for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11 python3.10; do
        if "$candidate" -c "$supported_python" 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
}

# Debian's python3 comes without ensurepip, which python3-venv brings.
missing_debian_packages() {
    command -v dpkg-query >/dev/null || return 0
    local package
    for package in "${debian_packages[@]}"; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || echo "$package"
    done
    [ -n "$(find_python)" ] || echo python3-venv
}

install_debian_packages() {
    local missing
    missing=$(missing_debian_packages | xargs)
    [ -n "$missing" ] || return 0
    [ "$(id -u)" = 0 ] || stop "Debian packages are missing; install them, then run this again: sudo apt-get install $missing"
    say "installing Debian packages: $missing"
    export DEBIAN_FRONTEND=noninteractive
    # One unreachable source must not stop the set-up: apt-get install says what it could not find.
    apt-get update -qq || say "apt-get update failed; trying with the package lists at hand"
    # shellcheck disable=SC2086  # a list of names
    apt-get install -y -qq --no-install-recommends $missing </dev/null >/dev/null
}

# What the environment depends on: a change of any part makes the next run install again.
fingerprint() {
    { cat pyproject.toml constraints-cpu.txt scripts/setup.sh && pwd && "$1" --version; } | sha256sum | cut -d ' ' -f 1
}

install_environment() {
    local python=$1
    say "installing Python packages into .venv with $("$python" --version); the first time this takes minutes"
    if [ "$(.venv/bin/python --version 2>/dev/null)" != "$("$python" --version)" ]; then
        "$python" -m venv --clear .venv
    fi
    rm -f "$packages_stamp" "$kernels_stamp"
    .venv/bin/python -m pip install -qq --disable-pip-version-check --no-compile -c constraints-cpu.txt -e '.[all,dev]' </dev/null
    # pip compiles on one core only, and the packages' own tests, too. Some files are for other Pythons and do not compile.
    .venv/bin/python -m compileall -qq -j 0 -x '/tests/' .venv/lib >/dev/null 2>&1 || true
    fingerprint "$python" >"$packages_stamp"
}

compile_kernels() {
    say "compiling the kernels"
    .venv/bin/python -W ignore scripts/warm_up.py
    cp "$packages_stamp" "$kernels_stamp"
}

# The libraries can vanish without .venv changing (a new container with the old checkout), so they are looked at first.
install_debian_packages
python=$(find_python)
[ -n "$python" ] || stop "no Python 3.10-3.13 with the venv module found; install one and name it: make PYTHON=/path/to/python3"
[ "$(cat "$packages_stamp" 2>/dev/null)" = "$(fingerprint "$python")" ] || install_environment "$python"
[ "${1:-}" = packages ] || cmp -s "$packages_stamp" "$kernels_stamp" || compile_kernels
