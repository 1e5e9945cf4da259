#!/usr/bin/env bash
# Sets up what `make demo` and `make test` need: a virtual environment with the project in it, and a libLLVM for Dr.Jit.
# Nothing outside $VENV is touched, except that libLLVM (and libGL, for OpenCV) is installed with apt where that is possible
# and needed.
#   VENV         the environment (.venv); made if it is not there
#   PYTHON       interpreter to make it from (default: the first Python >= 3.10 on the path)
#   EXTRAS       extras of pyproject.toml to install too: `dev` for the tests, `photos` for the demo on photographs
#   SYSTEM_SITE  not empty: the environment also sees that interpreter's packages, so an installed torch is kept
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=${VENV:-.venv}
python=$venv/bin/python
oldest_llvm=17
quiet=--quiet
[ -t 2 ] && quiet= # someone watches: let pip and uv show what they do

say() { printf '%s\n' "$*" >&2; }
die() { say "setup: $*"; exit 1; }
have() { command -v "$1" >/dev/null 2>&1; }
recent() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1; }

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.10 python}; do
        if have "$candidate" && recent "$candidate"; then command -v "$candidate"; return; fi
    done
    return 1
}

make_environment() {
    if [ -e "$python" ] && recent "$python"; then return; fi
    [ "$venv" = .venv ] && rm -rf .venv # half made, or its interpreter is gone; never do that to an environment of the user's
    [ -e "$venv" ] && die "$venv: expected an environment with Python >= 3.10, got something else; name another with VENV=..."
    local base
    if base=$(find_python); then
        say "setup: making $venv with $base"
    elif [ -z "${PYTHON:-}${SYSTEM_SITE:-}" ] && have uv; then
        uv venv --quiet --seed --python '>=3.10' "$venv" # uv brings an interpreter of its own
        return
    else
        die "${PYTHON:-python3}: expected Python >= 3.10, found none; install one, or name it: make PYTHON=/path/to/python"
    fi
    if [ -z "${SYSTEM_SITE:-}" ] && have uv; then
        uv venv --quiet --seed --python "$base" "$venv"
    else
        "$base" -m venv ${SYSTEM_SITE:+--system-site-packages} "$venv" >&2 ||
            die "$base has no working venv module; on Debian and Ubuntu: apt install python3-venv"
    fi
}

install_project() {
    local project=".${EXTRAS:+[$EXTRAS]}"
    say "setup: installing mi-splat${EXTRAS:+ with the extras $EXTRAS} into $venv (PyTorch is several gigabytes; minutes, once)"
    # uv does not count the packages of --system-site-packages as installed, pip does.
    if [ -z "${SYSTEM_SITE:-}" ] && have uv; then
        uv pip install ${quiet:+--quiet} --python "$python" -e "$project" && return
        say "setup: uv could not install it; trying pip"
    fi
    "$python" -m pip --version >/dev/null 2>&1 || "$python" -m ensurepip >/dev/null 2>&1 || die "$python has no pip"
    "$python" -m pip install ${quiet:+-qq} --disable-pip-version-check --no-input -e "$project"
}

llvm_there() { "$python" -c 'from mi_splat.render.setup import prepare_llvm; prepare_llvm()' >/dev/null 2>&1; }

newest_in_apt() {
    apt-cache pkgnames libllvm 2>/dev/null | sed -nE 's/^(libllvm([0-9]+)(t64)?)$/\2 \1/p' | sort -n |
        awk -v oldest="$oldest_llvm" '$1 >= oldest { name = $2 } END { print name }'
}

install_llvm() {
    llvm_there && return
    if have apt-get && [ "$(id -u)" = 0 ]; then
        say "setup: installing a libLLVM >= $oldest_llvm with apt"
        [ -n "$(newest_in_apt)" ] || apt-get update -qq </dev/null >/dev/null || true
        local package
        package=$(newest_in_apt)
        if [ -n "$package" ]; then
            DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$package" </dev/null >/dev/null || true
        fi
        llvm_there && return
    fi
    die "libLLVM: $("$python" -c 'from mi_splat.render.setup import llvm_hint; print(llvm_hint())'), then run make again"
}

# OpenCV, which ultralytics needs, wants two libraries that small images lack. Without them YOLO's tests are left out.
install_gl() {
    "$python" -c 'import cv2' >/dev/null 2>&1 && return
    if have apt-get && [ "$(id -u)" = 0 ]; then
        say "setup: installing libGL and GLib with apt, for OpenCV"
        apt-get update -qq </dev/null >/dev/null || true
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends libgl1 libglib2.0-0 </dev/null >/dev/null || true
    fi
    "$python" -c 'import cv2' >/dev/null 2>&1 || say "setup: OpenCV does not load, so YOLO detectors will not work here"
}

make_environment
install_project
install_llvm
[ -z "${EXTRAS:-}" ] || install_gl
say "setup: done"
