#!/bin/sh
# Sets .venv up (once) and runs the tests; arguments go to pytest, e.g. sh tools/test.sh -k report
set -eu
cd "$(dirname "$0")/.."
. tools/setup.sh
set_up dev
exec .venv/bin/python -m pytest -n 2 "$@"
