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
# Dependency groups need pip 25.1.
.venv/bin/python -m pip install --quiet --disable-pip-version-check "pip>=25.1"
install() { .venv/bin/python -m pip install --quiet --disable-pip-version-check --prefer-binary -c constraints.txt -e ".[all]"; }
install || {
    command -v cc >/dev/null || command -v gcc >/dev/null || command -v clang >/dev/null && exit 1
    echo "no C compiler, and none could be downloaded: installing without the compiled kernels"
    STAPESKIT_KERNELS=numpy install
}
# What would otherwise be built in the user's first run: byte code and matplotlib's list of fonts.
.venv/bin/python -m compileall -q stapeskit kinematics ct_inertia fitting pipeline
.venv/bin/python -c 'import matplotlib.font_manager, trimesh, skimage.measure' 2>/dev/null || true
