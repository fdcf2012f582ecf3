#!/bin/sh
# Sets .venv up (once) and runs the fast tests: an instance of every law; with --all first, every test.
# Other arguments go to pytest, e.g. sh tools/test.sh -k report
set -eu
cd "$(dirname "$0")/.."
. tools/setup.sh
set_up dev
selected="not slow and not studies"
if [ "${1:-}" = --all ]; then
    selected=""
    shift
fi
# two workers, each on one core: threads of both would only wait for each other
export OMP_NUM_THREADS=1
# compiled modules are kept: the other worker, and processes that tests start, read what was compiled once
unset PYTHONDONTWRITEBYTECODE
exec .venv/bin/python -m pytest -n 2 --dist worksteal --durations=25 -m "$selected" "$@"
