#!/bin/sh
# Makes .venv with stapeskit and its optional packages, and looks for the GL libraries that pymeshlab needs.
set -eu
: "${PYTHON:=python3}"

"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "stapeskit needs Python 3.11 or newer; got $("$PYTHON" --version). Name another one: make PYTHON=python3.12 ..." >&2
    exit 1
}

missing=""
for library in libGL.so.1:libgl1 libOpenGL.so.0:libopengl0 libEGL.so.1:libegl1; do
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null | grep -q "${library%%:*}" || missing="$missing ${library##*:}"
done
if [ -n "$missing" ] && command -v apt-get >/dev/null 2>&1; then
    as_root=""
    [ "$(id -u)" = 0 ] || as_root="sudo -n"
    echo "installing the GL libraries:$missing"
    { $as_root apt-get update -qq && $as_root apt-get install -y -qq --no-install-recommends $missing; } >/dev/null 2>&1 ||
        echo "The GL libraries could not be installed; the second opinion of pymeshlab will be missing. To have them: apt-get install -y --no-install-recommends$missing"
elif [ -n "$missing" ]; then
    echo "GL libraries are missing ($missing ); the second opinion of pymeshlab will be missing. Install them with your package manager."
fi

"$PYTHON" -m venv .venv
.venv/bin/python -m pip install --quiet --disable-pip-version-check "pip>=25.1"
pip() { .venv/bin/python -m pip install --quiet --disable-pip-version-check "$@"; }
# Versions and content hashes of everything that is downloaded: "make lock" writes the list.
pip --no-compile --prefer-binary --require-hashes -r locks/run.txt
if command -v cc >/dev/null || command -v gcc >/dev/null || command -v clang >/dev/null; then
    pip --no-deps --no-build-isolation -e .
else
    # pip fetches zig's compiler for the build; without it numpy does what the kernels would
    pip --no-deps -e . || STAPESKIT_KERNELS=numpy pip --no-deps --no-build-isolation -e .
fi
# What would otherwise be built in the user's first run: byte code, by all processors at once where pip takes
# one (a package may hold templates that are no Python), and matplotlib's list of fonts. Not the packages' own tests,
# which are 40 % of them.
.venv/bin/python -m compileall -qq -j 0 -x 'site-packages/.*/tests/' .venv/lib || true
.venv/bin/python -m compileall -q legacy
.venv/bin/python -c 'import matplotlib.font_manager, trimesh, skimage.measure' 2>/dev/null || true
