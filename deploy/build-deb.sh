#!/usr/bin/env bash
# Builds the Debian package: both programs, units, manual pages, completions, the schema of topology
# files, the robot's description, topologies, documents.
#
#   deploy/build-deb.sh [--profile NAME] [--output DIR]
#
#   --profile  Cargo profile of the programs (release). Anything else is for tests of the package:
#              `dev` takes what `cargo test` built and is ready in seconds.
#   --output   folder for the package (default: target/debian)
#
# Needs cargo-deb (cargo install --locked cargo-deb) and a C linker. It prints the package's path on
# standard output, everything else on standard error. Exit code 0, or 1 with the reason.
set -eu -o pipefail
cd "$(dirname "$0")/.."

fail() { printf 'build-deb: %s\n' "$*" >&2; exit 1; }

PROFILE=release
OUTPUT=
while [[ $# -gt 0 ]]; do
    case $1 in
        --profile) PROFILE=${2:?--profile needs a name} && shift 2 ;;
        --output) OUTPUT=${2:?--output needs a folder} && shift 2 ;;
        -h | --help) sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0"; exit 0 ;;
        *) fail "unknown option $1" ;;
    esac
done
[[ $(uname -m) == x86_64 ]] || fail "the package is for x86-64, not $(uname -m)"
cargo deb --version >/dev/null 2>&1 ||
    fail "cargo-deb is missing; install it with: cargo install --locked cargo-deb"
command -v strip >/dev/null || fail "strip is missing; install it with: apt-get install binutils"

TARGET=${CARGO_TARGET_DIR:-target}
[[ -n $OUTPUT ]] || OUTPUT=$TARGET/debian
# Cargo's folder of the profile `dev` has another name.
BUILT=$TARGET/$PROFILE
[[ $PROFILE != dev ]] || BUILT=$TARGET/debug
STAGE=$TARGET/release/deb

# What the programs hold of others: each crate with its licence, then each notice once.
third_party() {
    local crate licence folder notice sum
    local -A crates=() notices=()
    local sums=()
    printf 'Crates that hil-runtime and hil-recorder are built from, with their licences.\n\n'
    while IFS='|' read -r crate licence; do
        crate=${crate%% (*}
        printf '%-40s %s\n' "$crate" "$licence"
        folder=$(find "${CARGO_HOME:-$HOME/.cargo}/registry/src" -mindepth 2 -maxdepth 2 \
            -name "${crate/ v/-}" -print -quit)
        [[ -n $folder ]] || fail "the source of $crate is not in Cargo's registry"
        while IFS= read -r notice; do
            sum=$(sha256sum <"$notice")
            [[ -n ${notices[$sum]:-} ]] || { notices[$sum]=$notice && sums+=("$sum"); }
            crates[$sum]+="${crates[$sum]:+, }$crate"
        done < <(find "$folder" -maxdepth 1 -type f \
            \( -iname 'licen[cs]e*' -o -iname 'copying*' -o -iname 'notice*' \) | sort)
    done < <(cargo tree --locked --package hil-runtime --package hil-recorder --edges normal \
        --prefix none --no-dedupe --format '{p}|{l}' | grep -v "($PWD" | sed '/^$/d' | sort -u)
    for sum in "${sums[@]}"; do
        printf '\n%s\n%s\n\n' "$(printf '=%.0s' {1..80})" "${crates[$sum]}"
        cat "${notices[$sum]}"
    done
}

# For a test the features of the whole workspace and its tests will do, which `cargo test` takes too: one test selects them.
SELECTION=(--package hil-runtime --package hil-recorder)
[[ $PROFILE != dev ]] || SELECTION=(--workspace --test tidy)
cargo build --locked --profile "$PROFILE" "${SELECTION[@]}" --bin hil-runtime --bin hil-recorder >&2
rm -rf "$STAGE"
mkdir -p "$STAGE/bin" "$OUTPUT"
for program in hil-runtime hil-recorder; do
    strip -o "$STAGE/bin/$program" "$BUILT/$program"
    "$STAGE/bin/$program" documents "$STAGE/documents" >&2
done
gzip -9 --no-name "$STAGE"/documents/man1/*.1
third_party | gzip -9 --no-name >"$STAGE/third-party.txt.gz"
# What cargo-deb would build and strip is there already.
cargo deb --quiet --no-build --no-strip --locked --package hil-runtime --output "$OUTPUT" >&2
PACKAGE=$(find "$OUTPUT" -maxdepth 1 -name 'hil-runtime_*_amd64.deb' -newer "$STAGE/third-party.txt.gz")
[[ $(wc -l <<<"$PACKAGE") -eq 1 && -n $PACKAGE ]] || fail "no package in $OUTPUT"
printf '%s\n' "$PACKAGE"
