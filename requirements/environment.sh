#!/bin/sh
# Make the virtual environment $1 with a Python that can run the program.
# $PYTHON is tried first, then the versions the program is tested with.
set -eu

venv=$1
usable='import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))'
here=$(pwd)

if [ -x "$venv/bin/python" ] && "$venv/bin/python" -c "$usable" 2>/dev/null &&
    "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    # An environment that works stays, unless it was made for a checkout in another place.
    if [ ! -e "$venv/.python" ] || [ "$(cat "$venv/.python")" = "$here" ]; then
        printf '%s' "$here" >"$venv/.python"
        exit 0
    fi
fi

found=
for candidate in "$PYTHON" python3.13 python3.12 python3.11 python3.14; do
    if "$candidate" -c "$usable" 2>/dev/null; then
        found=$candidate
        break
    fi
done
if [ -z "$found" ]; then
    version=$("$PYTHON" --version 2>&1) || version="not found"
    echo "atmd-twin needs Python 3.11 to 3.14. '$PYTHON' is: $version." >&2
    echo "python3.11 to python3.14 are not there either. Install one of them," >&2
    echo "or say where it is: make PYTHON=/path/to/python3.12 ..." >&2
    exit 1
fi
if [ "$found" != "$PYTHON" ]; then
    echo "'$PYTHON' is not one of Python 3.11 to 3.14; using '$found'."
fi
if ! "$found" -c 'import ensurepip, venv' 2>/dev/null; then
    minor=$("$found" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    echo "'$found' cannot make virtual environments: its modules venv and ensurepip are missing." >&2
    echo "On Debian and Ubuntu: apt install python$minor-venv" >&2
    exit 1
fi

echo "Making the virtual environment $venv with $("$found" --version) ..."
"$found" -m venv --clear "$venv"
printf '%s' "$here" >"$venv/.python"
