#!/bin/sh
# Install into the virtual environment $1; the other arguments go to the installer as they are.
# uv is fast but does not read pip's configuration; where only that names a reachable index, pip does it.
set -eu

venv=$1
shift
# Bytecode is compiled here, once: it takes seconds off every start, and some machines never write it later.
if ! "$venv/bin/uv" pip install --quiet --compile-bytecode --python "$venv/bin/python" "$@"; then
    echo "uv could not install this; trying with pip ..." >&2
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"
fi
