#!/usr/bin/env python3
"""Judges what the two PCs of hardware-stamps.sh left: prints each figure, exits 1 if one is wrong.

Usage: hardware_stamps_check.py igb|e1000e FOLDER
"""
import glob
import json
import re
import sys

NIC, FOLDER = sys.argv[1], sys.argv[2]
HOSTS = ("control-pc", "robot-pc")
SENDERS = {"shuttle/command": HOSTS[0], "shuttle/status": HOSTS[1]}
# The card has one stamp register: what is sent before its driver read it gets none. How often
# that is depends on the load of the emulating host; the driver counts it, and so it is checked.
TX_SHARE_MIN = 0.5
# What a guard says when it had to act.
PUT_BACK = "ended without putting it back"
# Of each PC: the run that was ended there, its exit code, and how.
ROUGH_ENDS = {
    HOSTS[0]: ("killed", 137, "a run killed outright"),
    HOSTS[1]: ("twice", 131, "a run interrupted twice"),
}
failures = 0


def check(is_right, text):
    global failures
    failures += not is_right
    print(("ok      " if is_right else "WRONG   ") + text)


def microseconds(distribution, *names):
    if distribution["state"] != "measured":
        return "unavailable: " + distribution["reason"]
    return ", ".join(f"{name[:-3]} {distribution[name] / 1e3:.1f}" for name in names) + " us"


def finding(host, file_name):
    with open(f"{FOLDER}/{host}/{file_name}", encoding="utf-8") as file:
        findings = {one["id"]: one["value"] for one in json.load(file)["findings"]}
    return findings.get("card.eth0", "")


def setting(found):
    return found.split(";")[0]


def doctor(host):
    found = finding(host, "doctor.json")
    check(found != "", f"{host}: doctor examined the card")
    print(f"        doctor: {found}")
    words = "delivers" if NIC == "igb" else "advertised but never delivered"
    check(words in found, f"{host}: doctor says the card {words}")
    after = finding(host, "doctor-after.json")
    check(words in after, f"{host}: and says so after the run")
    if words not in after:
        print(f"        doctor: {after}")
    unchanged(host, "the run", "doctor-after.json")


def unchanged(host, what, file_name):
    before, after = setting(finding(host, "doctor.json")), setting(finding(host, file_name))
    check(after == before != "", f"{host}: after {what} the card is as it was found: {after}")


def words_of(host, file_name):
    with open(f"{FOLDER}/{host}/{file_name}", encoding="utf-8", errors="replace") as file:
        return file.read()


def rough_ends(host):
    """Programs that were ended while they had the card set up, and what became of it."""
    pairs = (line.split("=") for line in words_of(host, "codes.txt").splitlines())
    # The last attempt of several counts.
    codes = {name: int(code) for name, code in pairs}
    code = codes["interrupted_doctor"]
    check(code == 130, f"{host}: an interrupted doctor ends with {code}")
    caught = PUT_BACK in words_of(host, "interrupted-doctor.txt")
    check(caught, f"{host}: attempt {codes['interrupted_doctor_attempts']} was interrupted while "
          "the card was set up, and its guard put it back")
    unchanged(host, "an interrupted doctor", "doctor-interrupted-after.json")
    name, expected, what = ROUGH_ENDS[host]
    check(codes[name] == expected, f"{host}: {what} ends with {codes[name]}")
    during = setting(finding(host, f"doctor-{name}-during.json"))
    check("transmit on" in during, f"{host}: before that the card was set up: {during}")
    check(PUT_BACK in words_of(host, f"{name}-run.txt"), f"{host}: the guard says so")
    unchanged(host, what, f"doctor-{name}-after.json")


def probed_ptp(host):
    """A probe that asked for card stamps of PTP's datagrams, beside a PTP clock."""
    before = setting(finding(host, "doctor-ptp-before.json"))
    after = setting(finding(host, "doctor-ptp-after.json"))
    check("PTPv2 event" in before, f"{host}: a PTP clock has set its card up: {before}")
    check(after == before, f"{host}: a probe that asked for card stamps leaves it so: {after}")
    told = re.search(r"([\d,]+) of ([\d,]+) arrivals have the card's stamp", words_of(host, "probe.txt"))
    check(told is not None, f"{host}: the probe says how many arrivals the card stamped")
    if told is None:
        return
    stamped, arrived = (int(text.replace(",", "")) for text in told.groups())
    analysis = json.loads(words_of(host, "probe.json"))
    points = analysis["points"]

    def counted(is_card):
        chosen = [one for one in points if one["point"].endswith("by the card's clock") == is_card]
        return sum(one["figures"]["datagram_count"] for one in chosen if "(in)" in one["point"])

    # Without the transmit stamps that the e1000e owes it, ptp4l falls silent.
    least = 20 if NIC == "igb" else 0
    # The two rings begin, and end, one right after the other.
    check(arrived >= least and abs(counted(False) - arrived) <= 1,
          f"{host}: {arrived} arrivals, {counted(False)} in the kernel's part of the capture")
    check(counted(True) == stamped,
          f"{host}: the card stamped {stamped} of them, {counted(True)} are in its part")


def not_stamped(host):
    """Stamps that the card's driver itself says it did not give during the run."""
    counts = []
    for when in ("before", "after"):
        with open(f"{FOLDER}/{host}/card-{when}.txt", encoding="utf-8") as file:
            pairs = (line.split(":") for line in file if "tx_hwtstamp_" in line)
            counts.append({name.strip(): int(value) for name, value in pairs})
    before, after = counts
    return {name: after[name] - before[name] for name in after}


def card(one):
    story, clock = one["story"], one["clock"]
    name = story["host"] + "/" + story["interface"]
    print(f"        {name}: claims {story['claims']}")
    check(story["is_armed"], f"{name}: armed: {story['arming']}")
    check("put back" in story["restoring"] and "NOT" not in story["restoring"],
          f"{name}: {story['restoring']}")
    check(clock is not None, f"{name}: clock {story['clock']}")
    if not clock:
        return
    check(clock["pair_count"] > 50, f"{name}: {clock['pair_count']} pairs of clock reads")
    print(f"        {name}: card {clock['offset_ns'] / 1e3:.1f} us against the system clock, "
          f"within {clock['offset_bound_ns'] / 1e3:.1f} us; bound of all pairs p50 "
          f"{clock['bound_p50_ns'] / 1e3:.1f} us, max {clock['bound_max_ns'] / 1e3:.1f} us; "
          f"steps {clock['step_count']}")
    if clock["frequency"]:
        print(f"        {name}: card fast by {clock['frequency']['offset_ppb'] / 1e3:.3f} ppm, "
              f"within {clock['frequency']['bound_ppb'] / 1e3:.3f} ppm")
    check(clock["frequency"] is not None, f"{name}: frequency known")


def channel(one, summary):
    name = one["channel"]
    sent, stamped, both = one["sent_count"], one["tx_hardware_count"], one["tx_both_count"]
    check(sent > 100, f"{name}: {sent} messages left")
    account = next(c for c in summary["channels"] if c["name"] == name)["account"]
    software = account["coverage"]["tx_software"]
    check(software["stamped_count"] > 0,
          f"{name}: software TX {software['stamped_count']} of {software['eligible_count']}")
    text = f"{name}: hardware TX {stamped} of {sent}, with the software stamp beside it {both}"
    if NIC == "igb":
        check(stamped >= TX_SHARE_MIN * sent, f"{text} ({100 * stamped / sent:.2f} %)")
        given_up = not_stamped(SENDERS[name])
        told = ", ".join(f"{key} {value}" for key, value in given_up.items())
        # The driver counts those of clock exchanges as well.
        check(given_up and sent - stamped <= sum(given_up.values()),
              f"{name}: none of the {sent - stamped} missing was lost after the driver: it says "
              + told)
        check(both >= 0.95 * stamped, f"{name}: both kinds side by side on {both} of {stamped}")
        for segment in one["segments"][:2]:
            check(segment["distribution"]["state"] == "measured"
                  and segment["bound"]["state"] == "measured",
                  f"{name}: {segment['name']}: "
                  + microseconds(segment["distribution"], "p50_ns", "p99_ns", "max_ns")
                  + "; bound " + microseconds(segment["bound"], "p50_ns", "max_ns")
                  + f"; {segment['unplaced_count']} not placed")
        least = one["segments"][0]["distribution"].get("min_ns", 0)
        bound = one["segments"][0]["bound"].get("max_ns", 0)
        check(least + bound >= 0,
              f"{name}: no message left its card before it was handed over ({least / 1e3:.1f} us)")
    else:
        check(stamped == 0, text + ": advertised, never delivered")
    received, rx_reason = one["received_count"], one["rx_reason"]
    check(one["rx_hardware_count"] == 0 and rx_reason != "",
          f"{name}: hardware RX {one['rx_hardware_count']} of {received}: {rx_reason}")


for host in HOSTS:
    doctor(host)
    rough_ends(host)
    probed_ptp(host)
    paths = glob.glob(f"{FOLDER}/{host}/record/*/summary.json")
    check(len(paths) == 1, f"{host}: one run folder")
    if len(paths) != 1:
        continue
    with open(paths[0], encoding="utf-8") as file:
        summary = json.load(file)
    check(summary["run"]["outcome"] == "completed", f"{host}: run {summary['run']['outcome']}")
    if host == HOSTS[0]:
        stamps = summary["hardware_stamps"]
        check(stamps is not None and len(stamps["cards"]) == 2, "both cards are in the report")
        for one in stamps["cards"]:
            card(one)
        for one in stamps["channels"]:
            channel(one, summary)
        for note in summary["warnings"]:
            print("        note: " + note)
print("all of it holds" if failures == 0 else f"{failures} of it do not hold")
sys.exit(1 if failures else 0)
