#!/usr/bin/env bash
# Another maker's judgement of our recordings, on demand: `rerun mcap check` reads every message and
# looks whether times, chunks and index of each topic agree. Not part of the gate: rerun is 140 MB.
#
#   python3 -m venv /tmp/rerun && /tmp/rerun/bin/pip install -r tests/mcap_reader/check-requirements.txt
#   HIL_RERUN=/tmp/rerun/bin/rerun tests/mcap_reader/check.sh run.mcap ...
#
# Exit code 0: every topic of every file is `ok`. 1: one is not, or a file cannot be read. 2: usage.
set -u -o pipefail

rerun="${HIL_RERUN:-rerun}"
if [[ $# -eq 0 ]] || ! command -v "$rerun" >/dev/null; then
    echo "usage: HIL_RERUN=path/to/rerun $0 FILE.mcap ..." >&2
    exit 2
fi
# It would tell its makers that it was used.
settings="$(mktemp -d)" || exit 2
trap 'rm -rf "$settings"' EXIT
export HOME="$settings" XDG_CONFIG_HOME="$settings"
"$rerun" analytics disable >/dev/null 2>&1 || exit 2

failed=0
for file in "$@"; do
    if ! said="$("$rerun" mcap check --full "$file" 2>&1)"; then
        printf '%s\n' "$said"
        failed=1
        continue
    fi
    # One line a topic, below a rule; issues are in further lines without `ok` before them.
    topics="$(sed -n '/^──/,$p' <<<"$said" | tail -n +2 | grep -v '^[[:space:]]*$')"
    good="$(grep -c '^ok ' <<<"$topics")"
    other="$(grep -cv '^ok ' <<<"$topics")"
    if [[ "$good" -eq 0 || "$other" -ne 0 ]]; then
        printf '%s\n' "$said"
        failed=1
    else
        echo "$file: $good topics ok"
    fi
done
exit "$failed"
