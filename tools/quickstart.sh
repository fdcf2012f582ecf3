#!/bin/sh
# From a fresh checkout to a first result: sets .venv up (once) and localizes a bundled sample touch of a bundled part.
set -eu
cd "$(dirname "$0")/.."
. tools/setup.sh
set_up run
# the image itself says which part and sensor it is of
exec .venv/bin/geomtact localize meshes/samples/pin_1.png --out out/quickstart "$@"
