#!/usr/bin/env bash
# The gate: everything a change must pass, here and in CI.
#
#   ./check.sh          all steps
#   ./check.sh quick    formatting, lints, unit tests and house rules; no processes, no network
#
# Every step runs even when an earlier one failed, so one run shows all there is to mend. The tests
# come last: their result lines are what most readers look for. Exit code 0 only if all passed.
set -u -o pipefail
cd "$(dirname "$0")" || exit 1

mode="${1:-full}"
if [[ $# -gt 1 || ( "$mode" != full && "$mode" != quick ) ]]; then
    echo "usage: ./check.sh [quick]" >&2
    exit 2
fi

failed=()
summary=()

step() {
    local name="$1" start end verdict
    shift
    echo "== $name: $*"
    start=$(date +%s.%N)
    if "$@"; then verdict=ok; else verdict=FAILED; failed+=("$name"); fi
    end=$(date +%s.%N)
    summary+=("$(LC_ALL=C awk -v v="$verdict" -v n="$name" -v s="$start" -v e="$end" \
        'BEGIN { printf "%-6s  %-12s %8.1f s", v, n, e - s }')")
    echo "== ${summary[-1]}"
}

documentation() {
    RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps
}

dependencies() {
    if ! cargo deny --version >/dev/null 2>&1; then
        echo "cargo-deny is missing; install it with: cargo install --locked cargo-deny" >&2
        return 1
    fi
    # deny.toml says why advisories are not among these.
    cargo deny check bans licenses sources
}

unit_tests() {
    cargo test --workspace --exclude hil-tests --lib --bins &&
        cargo test --package hil-tests --test tidy
}

step format cargo fmt --all --check
step lints cargo clippy --workspace --all-targets -- -D warnings
if [[ "$mode" == quick ]]; then
    step tests unit_tests
else
    step dependencies dependencies
    step docs documentation
    step benches cargo bench --package hil-benches --no-run
    step tests cargo test --workspace --no-fail-fast
fi

echo
printf '%s\n' "${summary[@]}"
if [[ ${#failed[@]} -gt 0 ]]; then
    echo "FAILED: ${failed[*]}"
    exit 1
fi
echo "all steps passed"
