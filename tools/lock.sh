#!/bin/sh
# Writes locks/: the versions of all packages with their content hashes, for every platform and Python from 3.11.
# Versions stay where they are unless pyproject.toml asks for others; "sh tools/lock.sh --upgrade" takes the newest.
set -eu
: "${PYTHON:=python3}"
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
"$PYTHON" -m venv "$tools"
"$tools/bin/python" -m pip install --quiet --disable-pip-version-check uv
lock() {
    target=$1
    shift
    "$tools/bin/uv" pip compile --quiet --universal --generate-hashes --no-emit-index-url --no-header --no-annotate \
        --python-version 3.11.5 "$@" pyproject.toml -o "locks/$target"
}
mkdir -p locks
lock run.txt --extra all --group build "$@"
lock dev.txt --extra all --group build --group dev -c locks/run.txt "$@"
lock docs.txt --group docs -c locks/dev.txt "$@"
