#!/bin/sh
# Make a virtual environment with seaopt: sh tools/setup.sh FOLDER [CONSTRAINTS [EXTRAS]]
set -eu
venv=$1
constraints=${2:-constraints.txt}
project=.${3:+[$3]}
python=""
for candidate in "${PYTHON:-}" python3 python3.14 python3.13 python3.12 python3.11 python; do
    [ -n "$candidate" ] || continue
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    echo "seaopt needs Python 3.11 or newer: install one, or name it with PYTHON=..." >&2
    exit 2
fi
echo "setting up $venv with $("$python" --version); this takes a minute, once" >&2
if command -v uv >/dev/null 2>&1; then
    uv venv --quiet --allow-existing --python "$python" "$venv"
    VIRTUAL_ENV=$venv uv pip install --quiet --constraint "$constraints" --editable "$project"
else
    if ! "$python" -m venv "$venv"; then
        echo "this Python cannot make virtual environments: install its venv package (Debian: python3-venv), or uv" >&2
        exit 2
    fi
    # Bytecode of all libraries takes as long as unpacking them, and most is never imported: Python writes what is, once.
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile --constraint "$constraints" \
        --editable "$project"
fi
