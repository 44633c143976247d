#!/usr/bin/env bash
# Searches for inputs that make a decoder break its promises, and says how hard it searched.
#
#   tests/fuzz/run.sh [--seconds N | --executions N] [--jobs N] [--sanitizer none|address] [TARGET...]
#
# Without a target all of them, each for 60 seconds unless told otherwise, one at a time unless there
# are more jobs. Needs a nightly toolchain (rustup toolchain install nightly) and a C++ compiler; the
# targets are laid out as cargo-fuzz has them, for those who prefer it. The decoders are safe Rust, so
# the default is no sanitizer; "address" is for what they call.
#
# The seeds of tests/decoders are where a search begins; what it finds stays in corpus/ here, and what
# breaks a promise in artifacts/ here: mend it, and keep the file in tests/decoders/regressions/TARGET/.
# Exit code 0 when nothing broke, 1 when something did, 2 for a wrong argument or a failed build.
#
# Example: tests/fuzz/run.sh --executions 1000000 datagram topology
set -u -o pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
cd "$here" || exit 2

usage() {
    sed -n '2,17s/^# \{0,1\}//p' "$here/run.sh"
}

limit=(-max_total_time=60)
jobs=1
sanitizer=none
targets=()
while [[ $# -gt 0 ]]; do
    case "$1" in
        --seconds | --executions | --jobs | --sanitizer)
            option="$1"
            value="${2:-}"
            if [[ "$option" != --sanitizer && ! "$value" =~ ^[1-9][0-9]*$ ]]; then
                echo "$option is \"$value\", a whole number above 0 is expected" >&2
                exit 2
            fi
            case "$option" in
                --seconds) limit=("-max_total_time=$value") ;;
                --executions) limit=("-runs=$value") ;;
                --jobs) jobs="$value" ;;
                --sanitizer) sanitizer="$value" ;;
            esac
            shift 2
            ;;
        --help)
            usage
            exit 0
            ;;
        -*)
            echo "unknown option $1" >&2
            usage >&2
            exit 2
            ;;
        *)
            targets+=("$1")
            shift
            ;;
    esac
done
if [[ "$sanitizer" != none && "$sanitizer" != address ]]; then
    echo "--sanitizer is \"$sanitizer\", allowed are none, address" >&2
    exit 2
fi

mapfile -t known < <(sed -n 's/^path = "fuzz_targets\/\(.*\)\.rs"$/\1/p' Cargo.toml)
if [[ ${#targets[@]} -eq 0 ]]; then targets=("${known[@]}"); fi
for target in "${targets[@]}"; do
    if [[ ! " ${known[*]} " == *" $target "* ]]; then
        echo "no target is called $target; there are ${known[*]}" >&2
        exit 2
    fi
done
if ! cargo +nightly --version >/dev/null 2>&1; then
    echo "the nightly toolchain is missing: rustup toolchain install nightly" >&2
    exit 2
fi

# What cargo-fuzz passes too: counters at every edge and a record of every comparison.
flags=(-Cpasses=sancov-module -Ccodegen-units=1 --cfg fuzzing)
for flag in level=4 inline-8bit-counters pc-table trace-compares; do
    flags+=("-Cllvm-args=-sanitizer-coverage-$flag")
done
flags+=(-Cllvm-args=-simplifycfg-branch-fold-threshold=0)
if [[ "$sanitizer" == address ]]; then flags+=(-Zsanitizer=address); fi
# Without a target that needs it, the runtime is not built.
features=(--no-default-features)
chosen=()
for target in "${targets[@]}"; do
    chosen+=(--bin "$target")
    needs="$(grep -A1 "^path = \"fuzz_targets/$target.rs\"$" Cargo.toml | sed -n 's/^required-features = \["\(.*\)"\]$/\1/p')"
    if [[ -n "$needs" ]]; then features+=(--features "$needs"); fi
done
folder="${CARGO_TARGET_DIR:-$here/target}"
if [[ "$(uname -m)" == aarch64 ]]; then triple=aarch64-unknown-linux-gnu; else triple=x86_64-unknown-linux-gnu; fi
if ! CARGO_TARGET_DIR="$folder" RUSTFLAGS="${flags[*]}" cargo +nightly build --release \
    --target "$triple" "${features[@]}" "${chosen[@]}" >&2; then
    echo "the targets cannot be built" >&2
    exit 2
fi

logs="$(mktemp -d)"
trap 'rm -rf "$logs"' EXIT

search() {
    local target="$1" seeds=()
    mkdir -p "corpus/$target" "artifacts/$target"
    for folder_of_seeds in "../decoders/corpus/$target" "../decoders/regressions/$target"; do
        if [[ -d "$folder_of_seeds" ]]; then seeds+=("$folder_of_seeds"); fi
    done
    "$folder/$triple/release/$target" "${limit[@]}" -print_final_stats=1 -timeout=20 \
        -rss_limit_mb=2048 -max_len=8192 -artifact_prefix="artifacts/$target/" \
        "corpus/$target" "${seeds[@]}" >"$logs/$target" 2>&1
    echo $? >"$logs/$target.code"
}

running=0
for target in "${targets[@]}"; do
    search "$target" &
    running=$((running + 1))
    if [[ $running -ge $jobs ]]; then
        wait -n
        running=$((running - 1))
    fi
done
wait

stat() {
    sed -n "s/^stat::$2: *//p" "$logs/$1" | tail -1
}

printf '%-18s %14s %10s %10s %10s %8s\n' target executions exec/s coverage corpus broken
total=0
broken=0
for target in "${targets[@]}"; do
    executions="$(stat "$target" number_of_executed_units)"
    speed="$(stat "$target" average_exec_per_sec)"
    coverage="$(sed -n 's/.* cov: \([0-9]*\).*/\1/p' "$logs/$target" | tail -1)"
    corpus="$(find "corpus/$target" -type f | wc -l)"
    code="$(cat "$logs/$target.code")"
    total=$((total + ${executions:-0}))
    if [[ "$code" -ne 0 ]]; then
        broken=$((broken + 1))
        sed -n '/panicked at/,/^SUMMARY/p; /ERROR:/,/^SUMMARY/p' "$logs/$target" | head -40 >&2
        grep -a 'Test unit written to' "$logs/$target" >&2
    fi
    printf '%-18s %14s %10s %10s %10s %8s\n' "$target" "${executions:-?}" "${speed:-?}" \
        "${coverage:-?}" "$corpus" "$([[ "$code" -eq 0 ]] && echo no || echo YES)"
done
printf '%-18s %14s\n' total "$total"
[[ $broken -eq 0 ]]
