#!/bin/sh
# Builds the programs that the tests start, before the first of them runs; tests/src/binary.rs reads the variable.
set -eu
${CARGO:-cargo} build --quiet --workspace --bins
echo "HIL_PROGRAMS_BUILT=debug" >> "$NEXTEST_ENV"
