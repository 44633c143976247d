#!/usr/bin/env bash
# The gate: everything a change must pass, here and in CI.
#
#   ./check.sh          all steps
#   ./check.sh quick    formatting, lints, unit tests and house rules; no processes, no network
#   ./check.sh long     what takes too long for every change: a soak, an hour's chaos, whole lengths
#
# Every step runs even when an earlier one failed, so one run shows all there is to mend. The tests
# come last: their result lines are what most readers look for. Exit code 0 only if all passed.
set -u -o pipefail
cd "$(dirname "$0")" || exit 1

mode="${1:-full}"
if [[ $# -gt 1 || ! "$mode" =~ ^(full|quick|long)$ ]]; then
    echo "usage: ./check.sh [quick|long]" >&2
    exit 2
fi

failed=()
summary=()
# What the tests said, for their slowest and their result.
said="$(mktemp)"
trap 'rm -f "$said"' EXIT

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

# .config/nextest.toml says what runs beside what.
nextest() {
    if ! cargo nextest --version >/dev/null 2>&1; then
        echo "cargo-nextest is missing; install it with: cargo install --locked cargo-nextest" >&2
        return 1
    fi
    cargo nextest run --color never "$@" 2>&1 | tee "$said"
}

slowest() {
    echo "the slowest tests:"
    # Lines of one test: `PASS [   1.234s] ( 12/345) package::binary name`.
    LC_ALL=C sed -nE 's/^ *(PASS|FAIL|LEAK|TIMEOUT|TMT|FLAKY|SIG[A-Z]*) +\[ *([0-9.]+)s\] (\([^)]*\) )?(.*)$/\2 \4/p' "$said" |
        LC_ALL=C sort -k2 -k1,1nr | LC_ALL=C awk '!seen[$2 " " $3]++' | LC_ALL=C sort -rn | head -n 10 |
        LC_ALL=C awk '{ printf "%8.1f s  %s %s\n", $1, $2, $3 }'
}

if [[ "$mode" == long ]]; then
    # The chaos of one more hour, and ten minutes of soak, unless the caller says otherwise.
    export HIL_CHAOS_EPISODES="${HIL_CHAOS_EPISODES:-200}" HIL_CHAOS_SEED="${HIL_CHAOS_SEED:-1000}"
    export HIL_SOAK_MINUTES="${HIL_SOAK_MINUTES:-10}"
    step tests nextest --workspace --profile long --run-ignored all \
        --filterset 'not (package(hil-stats) & (binary(coverage) | binary(connection)))'
    # Many runs of many messages: optimised.
    step coverage cargo test --release -p hil-stats --test coverage --test connection -- --ignored --nocapture
    # The exhaustive searches of the safe coordinator, and its robots under the worst mixes of impairments.
    step fleet cargo test --release -p hil-fleet -- --ignored --nocapture --test-threads 1
else
    step format cargo fmt --all --check
    # All targets: the benches are checked here and not built with optimisation.
    step lints cargo clippy --workspace --all-targets -- -D warnings
    if [[ "$mode" == quick ]]; then
        step tests nextest --workspace --lib --bins --test tidy --profile ci \
            --filterset 'not (package(hil-tests) and kind(lib))'
    else
        step dependencies dependencies
        step docs documentation
        # Compile-fail guards, e.g. that instants and durations do not mix (models).
        step doctests cargo test --workspace --doc
        step tests nextest --workspace --profile ci
    fi
fi

echo
slowest
echo
printf '%s\n' "${summary[@]}"
if [[ ${#failed[@]} -gt 0 ]]; then echo "FAILED: ${failed[*]}"; else echo "all steps passed"; fi
# The result of the tests once more, as the last thing to be read.
grep -E '^ *Summary \[' "$said"
[[ ${#failed[@]} -eq 0 ]]
