#!/bin/sh
# Checks the bundle and the board, builds the engine (once), checks its numbers, times it, and writes the result
# beside the bundle. `sh run.sh --help` lists the options. Nothing is installed and nothing in the bundle changes.
set -eu
here=$(CDPATH='' cd -- "$(dirname -- "$0")" && pwd -P)
export PYTHONIOENCODING=utf-8:backslashreplace
exec "${PYTHON:-python3}" -B "$here/board.py" run "$@"
