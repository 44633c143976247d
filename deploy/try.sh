#!/bin/sh
# A teleoperated robot for ten seconds over a link with outages and over the clean one, once for each seed, and whether
# the outages hurt it. The two hosts are namespaces of this PC; it needs no root. The README's first command.
#
#   deploy/try.sh [SEED...]
set -eu
root=$(CDPATH="" cd -- "$(dirname "$0")/.." && pwd)
target=${CARGO_TARGET_DIR:-$root/target}
${CARGO:-cargo} build --release --manifest-path "$root/Cargo.toml" --bin hil-runtime
program=$target/release/hil-runtime
runs=runs/try-$(date +%Y%m%d-%H%M%S)
[ $# -gt 0 ] || set -- 4 5 6

# A run that the host could not keep up with, as a busy one, is put aside and repeated, twice at most.
run() {
    for attempt in 1 2 3; do
        echo "== $1, seed $seed" >&2
        folder=$runs/$1-$seed
        report=$("$program" --topology "$root/deploy/topologies/$2" --on-one-pc --set "name=$1" \
            --set "run.duration=10 s" --set "run.seed=$seed" --set "run.record=$folder") || {
            code=$?
            printf '%s\n' "$report"
            exit "$code"
        }
        case $report in
        *"NOT VALID"*)
            printf '%s\n' "$report" | grep -A 2 "NOT VALID" >&2
            [ "$attempt" = 3 ] || mv "$folder" "$runs/invalid-$1-$seed-$attempt"
            ;;
        *) break ;;
        esac
    done
}

for seed; do
    run outages split-outages.toml
    run clean split.toml
done
"$program" compare --base "$runs"/clean-*/*-control-pc --new "$runs"/outages-*/*-control-pc
