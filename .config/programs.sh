#!/bin/sh
# Builds the programs that the tests start, before the first of them runs; tests/src/binary.rs reads the variable. With one
# test cargo takes the features of all tests: without, it would build most crates a second time.
set -eu
${CARGO:-cargo} build --quiet --workspace --bins --test tidy
echo "HIL_PROGRAMS_BUILT=debug" >> "$NEXTEST_ENV"
