#!/usr/bin/env bash
# The package on two PCs with systemd: installed, started, hurt, booted again and purged.
#
#   tests/lab/systemd.sh [--deb FILE] [--output DIR]
#
#   --deb      package to test (default: built now by deploy/build-deb.sh --profile dev)
#   --output   folder for the journals of both PCs, new or empty (default: kept only on failure, in a
#              folder named at the end)
#
# Two containers with systemd as their first process, joined by a cable (see nspawn.sh), stand for
# control-pc and robot-pc. It shows, each with PASS or FAIL and figures: what apt installs; a split run by
# `systemctl enable --now` whose account closes, with its report and recording; units that come
# back by themselves after the supervisor was killed, after a process of a run hung, after the
# supervisor hung, and after a boot; a clean stop; what a user without rights is told; and that a purge
# leaves nothing. Needs root and python3; installs mmdebstrap and makes a root file system of 300 MB in the cache
# folder the first time (see lib.sh). Takes about three minutes after that and never more than fifteen.
# Exit code 0 when all holds, 1 when something does not, 2 when the lab could not be set up.
set -u -o pipefail
# shellcheck source=tests/lab/lib.sh
source "$(dirname "$0")/lib.sh"
# shellcheck source=tests/lab/nspawn.sh
source "$LAB_DIR/nspawn.sh"

TIME_LIMIT=900
PCS=(control-pc robot-pc)
STATE=/var/lib/hil-runtime
WORKSPACE=$(cd "$LAB_DIR/../.." && pwd)
DEB=
OUTPUT=
FAILED=0

while [[ $# -gt 0 ]]; do
    case $1 in
        --deb) DEB=${2:?} && shift 2 ;;
        --output) OUTPUT=${2:?} && shift 2 ;;
        -h | --help) sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0"; exit 0 ;;
        *) lab_fail "unknown option $1" ;;
    esac
done
[[ -z $OUTPUT || ! -e $OUTPUT || -d $OUTPUT ]] || lab_fail "--output $OUTPUT is no folder"
[[ -z $OUTPUT || ! -d $OUTPUT || -z $(ls -A "$OUTPUT") ]] ||
    lab_fail "--output $OUTPUT is not empty; what is in it is kept"
[[ -z $DEB || -f $DEB ]] || lab_fail "--deb $DEB is no file"

# check WORDS COMMAND...: the command's output follows the words.
check() {
    local words=$1 figures
    shift
    if figures=$("$@" 2>&1); then
        printf 'PASS  %s%s\n' "$words" "${figures:+: ${figures//$'\n'/; }}"
    else
        printf 'FAIL  %s%s\n' "$words" "${figures:+: ${figures//$'\n'/; }}"
        FAILED=1
    fi
}

# within SECONDS COMMAND...: how long it took until the command was true.
within() {
    local limit=$1 began=$EPOCHREALTIME
    shift
    if ! lab_until "$limit" "$@"; then
        printf 'not within %d s' "$limit"
        return 1
    fi
    awk -v from="$began" -v to="$EPOCHREALTIME" 'BEGIN { printf "after %.1f s", to - from }'
}

both() {
    local name
    for name in "${PCS[@]}"; do "$@" "$name" || return 1; done
}

# property NAME UNIT KEY
property() { pc "$1" systemctl show --property "$3" --value "$2.service"; }
is() { [[ $(property "$1" "$2" "$3") == "$4" ]]; }
runs() { [[ $(property "$2" "hil-runtime@$1" StatusText) =~ ^[0-9.]+\ /\ [0-9]+\ s ]]; }
waits() { [[ $(property "$2" "hil-runtime@$1" StatusText) == "waiting for "* ]]; }
is_done() { is "$2" "hil-runtime@$1" ActiveState inactive && is "$2" "hil-runtime@$1" Result success; }
restarts() { property "$2" "hil-runtime@$1" NRestarts; }
journal() { pc "$2" journalctl --boot --output=cat --unit "hil-runtime@$1.service" "${@:3}"; }
# The newest folder of the runs of an instance.
newest() { pc "$2" sh -c "ls -d $STATE/$1/runs/* | tail -n 1"; }

# run_counts INSTANCE NAME: how often it ran to the end.
finished_runs() { pc "$2" sh -c "ls $STATE/$1/runs/*/report.txt 2>/dev/null | wc -l"; }

# --- what apt installs ---------------------------------------------------------------------------

# Every path that a package could have left, without what other programs write meanwhile.
files_of() {
    pc "$1" find / -xdev \( -path /var/log -o -path /var/lib/dpkg -o -path /var/lib/apt \
        -o -path /var/cache -o -path /var/lib/systemd -o -path /proc -o -path /sys -o -path /root \
        -o -path '/etc/*-' -o -path /etc/.pwd.lock \) -prune -o -print | sort
    pc "$1" find /run /dev/shm /tmp /var/tmp -name '*hil*' | sort
}

install_on() {
    files_of "$1" >"$PC_WORK/$1/before.txt"
    cp "$DEB" "$PC_WORK/$1/root/root/hil-runtime.deb" &&
        pc "$1" apt-get --quiet --quiet --yes install /root/hil-runtime.deb >"$PC_WORK/$1/apt.txt" 2>&1 ||
        { tail -n 5 "$PC_WORK/$1/apt.txt"; return 1; }
    pc "$1" dpkg-query --show --showformat '${Package} ${Version}, ${Installed-Size} KiB' hil-runtime
}

is_installed_disabled() {
    local unit
    for unit in hil-runtime hil-recorder; do
        [[ $(pc "$1" systemctl is-enabled "$unit@split.service") == disabled ]] || return 1
        ! pc "$1" systemctl is-active --quiet "$unit@split.service" || return 1
    done
    pc "$1" id hil && [[ $(pc "$1" getent passwd hil) == *nologin ]]
}

units_are_valid() {
    local words
    words=$(pc "$1" systemd-analyze verify --man=no hil-runtime@split.service hil-recorder@split.service 2>&1)
    [[ -z $words ]] || { echo "$words"; return 1; }
    pc "$1" systemd-analyze security --no-pager hil-runtime@split.service | tail -n 1 | sed 's/^[^A-Za-z]*//'
}

has_documents() {
    pc "$1" sh -c 'zgrep -q "EXIT STATUS" /usr/share/man/man1/hil-runtime-doctor.1.gz &&
        test -s /usr/share/bash-completion/completions/hil-runtime &&
        test -s /usr/lib/x86_64-linux-gnu/wireshark/plugins/hil.lua &&
        test -s /usr/share/hil-runtime/topology.schema.json &&
        test -s /usr/share/hil-runtime/robots/yumi.urdf &&
        ls /usr/share/man/man1/hil-* | wc -l' && echo "manual pages"
}

# --- a split run -----------------------------------------------------------------------------------

write_topologies() {
    local etc=$PC_WORK/$1/root/etc/hil-runtime
    cp "$LAB_DIR/systemd-split.toml" "$etc/split.toml" &&
        printf 'extends = "split.toml"\nname = "long"\nrun.duration = "30 min"\n' >"$etc/long.toml" &&
        share_key "$1"
}

# The first PC makes the key; both give it to the user of the service.
share_key() {
    local key=/etc/hil-runtime/hop.key
    if [[ -e $PC_WORK/hop.key ]]; then
        install --mode=600 "$PC_WORK/hop.key" "$PC_WORK/$1/root$key"
    else
        pc "$1" hil-runtime key new "$key" && install --mode=600 "$PC_WORK/$1/root$key" "$PC_WORK/hop.key"
    fi &&
        pc "$1" hil-runtime key check "$key" && pc "$1" chown hil: "$key" &&
        pc "$1" runuser -u hil -- hil-runtime --topology /etc/hil-runtime/split.toml --check --host "$1" |
        grep "$key: the key"
}

is_waiting_and_up() {
    is "$1" hil-runtime@split ActiveState active && waits split "$1" &&
        property "$1" hil-runtime@split StatusText
}

# Every channel that carried messages closes for all of them.
account_closes() {
    pc "$1" cat "$(newest split "$1")/summary.json" | python3 -c '
import json, sys
channels = [c["account"] for c in json.load(sys.stdin)["channels"]]
channels = [a for a in channels if a and a["published_count"]]
closings = [a["closing"] for a in channels]
checked = sum(c.get("checked_count", 0) for c in closings)
unclosed = [c for c in closings if c["state"] != "checked" or c["closed_count"] != c["checked_count"]]
print(f"{len(closings)} channels, {checked} messages, {len(unclosed)} channels open")
sys.exit(len(closings) < 4 or checked < 1000 or len(unclosed) > 0)'
}

# The last lines of a run.
journal_answers() {
    journal split "$1" | grep -E -o 'Did the network hurt the robot\?.*'
}

has_report() {
    local folder
    folder=$(newest split "$1")
    pc "$1" test -s "$folder/report.txt" -a -s "$folder/summary.json" && echo "$folder"
}

# What the topology asks for, of the processes of both hosts.
rights_are_granted() {
    local section
    section=$(pc "$1" cat "$(newest split "$1")/report-full.txt" | awk '/^(  )?[A-Z]/ { on = /^  Real time/ } on')
    ! grep '^ *refused' <<<"$section" || return 1
    grep -o 'SCHED_FIFO [45]0 granted\|locked memory granted' <<<"$section"
    [[ $(grep -c 'SCHED_FIFO [45]0 granted\|locked memory granted' <<<"$section") -eq 3 ]]
}

# What the doctor says as the unit, with its user, its rights and all that it is forbidden.
doctor_finds_the_rights_of_the_unit() {
    local folder=/etc/systemd/system/hil-runtime@doctor.service.d words
    pc "$1" mkdir -p $folder
    printf '[Service]\nType=oneshot\nExecStart=\nExecStart=/usr/bin/hil-runtime doctor\n' \
        >"$PC_WORK/$1/root$folder/doctor.conf"
    pc "$1" systemctl daemon-reload && pc "$1" systemctl start hil-runtime@doctor.service || return 1
    words=$(journal doctor "$1")
    ! grep -E 'EPERM|Operation not permitted|refused' <<<"$words" || return 1
    grep -E -o '80 granted|RLIMIT_MEMLOCK [a-z]*|CAP_IPC_LOCK held' <<<"$words" | sort -u
}

journal_has_priorities() {
    local errors words
    errors=$(journal split "$1" --priority err..err | wc -l)
    words=$(journal split "$1" --priority info..info | wc -l)
    [[ $errors -eq 0 && $words -gt 20 ]] && echo "$words lines of information, $errors errors"
}

is_recorded() {
    local file
    lab_until 20 is "$1" hil-recorder@split ActiveState inactive || return 1
    is "$1" hil-recorder@split Result success || return 1
    file=$(pc "$1" sh -c "ls $STATE/split/recordings/*.mcap | tail -n 1")
    [[ -n $file ]] || return 1
    pc "$1" journalctl --boot --output=cat --unit hil-recorder@split.service |
        grep -o '[0-9]* messages of the run, .*'
}

# --- what it survives ------------------------------------------------------------------------------

# Both run again, after one of them was hurt.
both_run_again() {
    local before=("$1" "$2") index name
    for index in 0 1; do
        name=${PCS[index]}
        [[ $(restarts long "$name") -gt ${before[index]} ]] && runs long "$name" || return 1
    done
}

# survives WORDS NAME COMMAND...: the command hurts that PC.
survives() {
    local words=$1 before
    shift
    before=("$(restarts long control-pc)" "$(restarts long robot-pc)")
    "$@" || { check "$words" false; return; }
    check "$words, both PCs run again" within 120 both_run_again "${before[@]}"
    check "  with restarts on control-pc and robot-pc" \
        echo "$(restarts long control-pc) and $(restarts long robot-pc)"
}

kill_supervisor() { pc "$1" systemctl kill --kill-whom=main --signal=KILL hil-runtime@long.service; }
hang_supervisor() { pc "$1" systemctl kill --kill-whom=main --signal=STOP hil-runtime@long.service; }

# The robot's process, by the launch file that it was given.
hang_robot() { pc "$1" pkill --signal STOP --uid hil --full 'worker --launch .*/robot'; }

watchdog_fired() {
    local count
    count=$(journal long "$1" --priority err..info | grep -c 'Watchdog timeout')
    [[ $count -ge $2 ]] && echo "$count times"
}

silence_is_reported() {
    pc "$1" sh -c "grep -l 'no sign of life' $STATE/long/runs/*/report-full.txt | tail -n 1" | grep . &&
        journal long "$1" --priority warning..warning | grep -m 1 'no sign of life'
}

# --- the end ---------------------------------------------------------------------------------------

stops_cleanly() {
    local folder
    folder=$(newest long "$1")
    pc "$1" systemctl stop hil-runtime@long.service || return 1
    is "$1" hil-runtime@long ActiveState inactive || return 1
    pc "$1" grep -q 'interrupted by SIGTERM' "$folder/report.txt" || return 1
    journal long "$1" | tail -n 10 | grep 'Deactivated successfully' && echo "report complete in $folder"
}

is_left_clean() {
    local processes memory
    processes=$(pc "$1" pgrep --count --uid hil)
    memory=$(pc "$1" find /dev/shm /run/hil -mindepth 1 | wc -l)
    echo "$processes processes, $memory files in /dev/shm and /run/hil"
    [[ $processes -eq 0 && $memory -eq 0 ]]
}

unprivileged_run_says_what_it_lacks() {
    local words status=0
    words=$(pc "$1" runuser -u nobody -- hil-runtime --quiet --set run.duration=2s \
        --topology /usr/share/hil-runtime/topologies/shuttle-local.toml --set run.record=/tmp/nobody \
        --set processes.robot.scheduling=fifo --set processes.robot.priority=40 2>&1) || status=$?
    # The folder for its shared memory stays, empty.
    pc "$1" rm -rf /tmp/nobody /tmp/hil-65534
    [[ $status -eq 0 ]] && grep -m 1 -o 'SCHED_FIFO 40 refused: .*' <<<"$words"
}

foreign_folder_is_refused() {
    local words status=0
    words=$(pc "$1" runuser -u nobody -- hil-runtime --quiet --set run.duration=2s \
        --topology /usr/share/hil-runtime/topologies/shuttle-local.toml --set run.record=$STATE 2>&1) ||
        status=$?
    echo "exit code $status, ${words##*error: }"
    [[ $status -eq 77 && $words == *"$STATE"* ]]
}

upgrade_leaves_the_run_alone() {
    local before
    before=$(property "$1" hil-runtime@long MainPID)
    pc "$1" apt-get --quiet --quiet --yes --reinstall install /root/hil-runtime.deb \
        >"$PC_WORK/$1/upgrade.txt" 2>&1 || { tail -n 5 "$PC_WORK/$1/upgrade.txt"; return 1; }
    [[ $before -gt 0 && $(property "$1" hil-runtime@long MainPID) == "$before" ]] && runs long "$1"
}

purge() {
    local gone
    PC_TIMEOUT=330 pc "$1" apt-get --quiet --quiet --yes purge hil-runtime >"$PC_WORK/$1/purge.txt" 2>&1 ||
        { tail -n 5 "$PC_WORK/$1/purge.txt"; return 1; }
    files_of "$1" >"$PC_WORK/$1/after.txt"
    gone=$(diff "$PC_WORK/$1/before.txt" "$PC_WORK/$1/after.txt" | grep '^>')
    [[ -z $gone ]] || { echo "left: $gone"; return 1; }
    [[ $(pc "$1" pgrep --count --uid hil) -eq 0 ]] || { echo "processes are left"; return 1; }
    [[ -z $(pc "$1" systemctl list-units --all --plain --no-legend 'hil-*') ]] || return 1
    echo "$(wc -l <"$PC_WORK/$1/after.txt") paths as before, no process, nothing in /dev/shm"
}

# --- all of it -------------------------------------------------------------------------------------

keep_journals() {
    local name
    [[ -n $OUTPUT || $FAILED -ne 0 ]] || return 0
    [[ -n $OUTPUT ]] || OUTPUT=$(mktemp -d "${TMPDIR:-/tmp}/systemd-lab.XXXXXX")
    mkdir -p "$OUTPUT"
    for name in "${PCS[@]}"; do
        pc "$name" journalctl --no-pager --output=short-precise >"$OUTPUT/$name.journal.txt" 2>/dev/null
        cp "$PC_WORK/$name"/*.txt "$OUTPUT/" 2>/dev/null
    done
    echo "journals are in $OUTPUT"
}

a_split_run() {
    local name
    for name in "${PCS[@]}"; do
        check "$name: apt installs the package" install_on "$name"
        check "$name: units are there and disabled, user hil cannot log in" is_installed_disabled "$name"
        check "$name: systemd takes the units without a word" units_are_valid "$name"
        check "$name: documents are there" has_documents "$name"
        write_topologies "$name" && pc "$name" systemctl --quiet enable hil-recorder@split.service
    done
    check "control-pc: enable --now returns" pc control-pc \
        systemctl --quiet enable --now hil-runtime@split.service
    check "control-pc: is up and says whom it waits for" is_waiting_and_up control-pc
    check "robot-pc: enable --now returns" pc robot-pc \
        systemctl --quiet enable --now hil-runtime@split.service
    check "the run of 8 s goes on both" within 30 both runs split
    check "it ends on both, with success" within 60 both is_done split
    for name in "${PCS[@]}"; do
        check "$name: the account closes" account_closes "$name"
        check "$name: the journal ends in the answer" journal_answers "$name"
        check "$name: report" has_report "$name"
        check "$name: real time is granted to the unprivileged user" rights_are_granted "$name"
        check "$name: the unit forbids nothing that the doctor looks at" \
            doctor_finds_the_rights_of_the_unit "$name"
        check "$name: the journal knows priorities" journal_has_priorities "$name"
        check "$name: the recorder recorded it and ended" is_recorded "$name"
        check "$name: nothing is left over" is_left_clean "$name"
    done
}

hurts() {
    local name
    for name in "${PCS[@]}"; do pc "$name" systemctl start hil-runtime@long.service; done
    check "a run of 30 min goes on both" within 60 both runs long
    survives "control-pc: supervisor killed (SIGKILL)" kill_supervisor control-pc
    survives "robot-pc: a process of the run hangs (SIGSTOP)" hang_robot robot-pc
    check "robot-pc: the watchdog fired" watchdog_fired robot-pc 1
    check "robot-pc: report and journal name the process that hung" silence_is_reported robot-pc
    survives "control-pc: supervisor hangs (SIGSTOP)" hang_supervisor control-pc
    check "control-pc: the watchdog fired" watchdog_fired control-pc 1
    check "robot-pc: stops cleanly" stops_cleanly robot-pc
    pc control-pc systemctl stop hil-runtime@long.service
    for name in "${PCS[@]}"; do check "$name: nothing is left over" is_left_clean "$name"; done
}

ends() {
    local name
    for name in "${PCS[@]}"; do pc "$name" systemctl reboot 2>/dev/null; done
    for name in "${PCS[@]}"; do
        check "$name: goes down to boot again" within 90 pc_is_off "$name"
        pc_boot "$name"
        check "$name: is up" pc_uptime "$name"
    done
    check "the enabled run starts by itself and ends on both, with success" within 120 both is_done_after_boot
    check "control-pc: an unprivileged user's run says what it lacks" \
        unprivileged_run_says_what_it_lacks control-pc
    check "control-pc: a folder of another user is refused" foreign_folder_is_refused control-pc
    for name in "${PCS[@]}"; do pc "$name" systemctl start hil-runtime@long.service; done
    check "a run goes on both" within 60 both runs long
    check "control-pc: an upgrade leaves it alone" upgrade_leaves_the_run_alone control-pc
    for name in "${PCS[@]}"; do check "$name: purge in the middle of it leaves nothing" purge "$name"; done
}

pc_uptime() { pc "$1" systemd-analyze time | sed -n 's/.*finished in/systemd needed/p'; }

# Of the boot before there is one run.
is_done_after_boot() { is_done split "$1" && [[ $(finished_runs split "$1") -eq 2 ]]; }

main() {
    local name
    lab_need python3 python3-minimal
    pcs_requirements
    if [[ -z $DEB ]]; then
        lab_say "package"
        DEB=$("$WORKSPACE/deploy/build-deb.sh" --profile dev) || lab_fail "the package cannot be built"
    fi
    pcs_root
    if [[ -z ${LAB_BOUNDED:-} ]]; then
        LAB_BOUNDED=1 exec timeout --foreground --kill-after=60 "$TIME_LIMIT" \
            "$0" --deb "$DEB" ${OUTPUT:+--output "$OUTPUT"}
    fi
    pcs_begin
    for name in "${PCS[@]}"; do pc_make "$name"; done
    pcs_cable control-pc 10.77.0.1 robot-pc 10.77.0.2
    for name in "${PCS[@]}"; do
        pc_boot "$name"
        check "$name: is up" pc_uptime "$name"
    done
    a_split_run
    hurts
    ends
    keep_journals
    [[ $FAILED -eq 0 ]] && echo "all passed in $((SECONDS - LAB_STARTED)) s"
}

main
exit "$FAILED"
