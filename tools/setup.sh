#!/bin/sh
# Makes .venv with stapeskit and the tools of its tests; versions and hashes of everything are in requirements.lock.
set -eu
: "${PYTHON:=python3}"
"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "stapeskit needs Python 3.11 or newer; got $("$PYTHON" --version). Name another one: make PYTHON=python3.12 ..." >&2
    exit 1
}
# pymeshlab and VTK load these libraries of the system
missing=""
for library in libGL.so.1:libgl1 libOpenGL.so.0:libopengl0 libEGL.so.1:libegl1; do
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null | grep -q "${library%%:*}" || missing="$missing ${library##*:}"
done
if [ -n "$missing" ] && command -v apt-get >/dev/null 2>&1; then
    as_root=""
    [ "$(id -u)" = 0 ] || as_root="sudo -n"
    echo "installing the GL libraries:$missing"
    { $as_root apt-get update -qq && $as_root apt-get install -y -qq --no-install-recommends $missing; } >/dev/null 2>&1 ||
        echo "They could not be installed. To have them: apt-get install -y --no-install-recommends$missing"
elif [ -n "$missing" ]; then
    echo "GL libraries are missing ($missing ). Install them with your package manager."
fi
"$PYTHON" -m venv .venv
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --prefer-binary --require-hashes -r requirements.lock
.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
# byte code by all processors at once, without the packages' own tests, which are 40 % of them
.venv/bin/python -m compileall -qq -j 0 -x 'site-packages/.*/tests/' .venv/lib || true
.venv/bin/python -c 'import matplotlib.font_manager' 2>/dev/null || true
