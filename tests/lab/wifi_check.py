#!/usr/bin/env python3
"""Judges what the PC of wifi.sh left: prints each figure, exits 1 if one is wrong.

Usage: wifi_check.py FOLDER
"""
import json
import math
import pathlib
import sys

ROOT = pathlib.Path(sys.argv[1])
TRUE_DELAY_NS, TRUE_LOSS = 5_000_000, 0.02
# Between two medians: the wake-up of a timer.
TIMER_NS = 50_000
failures = 0


def check(holds, text):
    global failures
    failures += not holds
    print(("  holds   " if holds else "  FAILED  ") + text)


def wilson(successes, trials, z=1.959964):
    """95 % interval of a share (Wilson 1927)."""
    share, scale = successes / trials, 1 + z * z / trials
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    centre = share + z * z / (2 * trials)
    return (centre - spread) / scale, (centre + spread) / scale


def summary(name, host="robot-pc"):
    found = sorted((ROOT / name / host).glob("runs/*/summary.json"))
    if not found:
        sys.exit(f"no summary of {name} on {host}")
    return json.loads(found[-1].read_text(encoding="utf-8"))


def direction(channel, way):
    one = next(d for d in channel["directions"] if d["direction"] == way)
    return ({counter["name"]: counter["count"] for counter in one["counters"]},
            {fact["label"]: fact["value"] for fact in one["facts"]})


def check_closing(account):
    closing = account["closing"]
    check(closing["closed_count"] == closing["checked_count"] > 0,
          f"account closes: {closing['closed_count']} of {closing['checked_count']} messages")


def over_the_radio(channel, radio):
    sent, facts = direction(channel, "egress")
    _, facts_of_arrivals = direction(channel, "ingress")
    stamps, acks = radio["transmit_stamps"], radio["acknowledgements"]
    print(f" {channel['name']}: {facts.get('radio')}")
    check_closing(channel["account"])
    before, handed = stamps["before_queue_count"], stamps["handed_count"]
    check(before == handed > 0, f"stamped before the queue, and labelled: {before} of {handed}")
    fallback = facts.get("stamp fallback", "")
    check("before the queue" in fallback, f"fallback: {fallback}")
    datagrams = sent["socket: sent_count"]
    acked = sent["socket: radio_acknowledged_count"]
    unacked = sent["socket: radio_unacknowledged_count"]
    check(acked + unacked == datagrams > 0 and sent["socket: radio_unmatched_count"] == 0,
          f"one report per datagram: {datagrams} sent, {acked} acknowledged, {unacked} not")
    kinds = {name: acks[name]["count"] for name in ("acknowledged", "unacknowledged", "unreported")}
    of_messages = acks["handed_count"]
    check(sum(kinds.values()) == of_messages > 0 and kinds["unreported"] == 0,
          f"each of {of_messages} messages has its report: "
          + ", ".join(f"{name} {count}" for name, count in kinds.items() if count))
    print(f"          access category: {facts.get('access category')}")
    mark = facts_of_arrivals.get("mark", "")
    check(mark.startswith("dscp 46 on all"), f"mark: {mark}")


def stations(hops):
    check(len(hops) == 2, f"radios sampled: {[hop['process'] for hop in hops]}")
    for hop in hops:
        for station in hop["stations"]:
            print(f"          {hop['process']}: {station['mac']} "
                  f"{station['sample_count']} samples, signal {station['signal_dbm']}, "
                  f"{station['transmit_modulation']}, retries {station['tx_retry_count']}")
            check(station["sample_count"] > 10 and station["signal_dbm"] is not None,
                  "samples with a signal")


def one_way(channel):
    """From the send call to the receive stamp: the impairment sits where it sends."""
    account = channel["account"]
    ends = (("handed_to_kernel", "tx_software"), ("tx_software", "rx_software"))
    parts = [segment["distribution"] for segment in account["segments"]
             if (segment["from"], segment["to"]) in ends]
    bound = account["end_to_end"]["bound"]["largest_ns"]
    return sum(part["min_ns"] for part in parts), sum(part["p50_ns"] for part in parts), bound


def over_the_cable(plain, channel):
    _, plain_ns, plain_bound = one_way(plain)
    least, median, bound = one_way(channel)
    added = median - plain_ns
    print(f" {channel['name']}: one way {median / 1e3:.1f} us at the median, "
          f"{least / 1e3:.1f} at least, bound {bound} ns; plain {plain_ns / 1e3:.1f} us")
    check(abs(added - TRUE_DELAY_NS) <= bound + plain_bound + TIMER_NS,
          f"the cable adds {added / 1e3:.1f} us, 5000 asked for")
    check(least >= TRUE_DELAY_NS - bound,
          f"no message came before 5 ms less the bound of {bound} ns")
    account = channel["account"]
    lost, total = account["fates"].get("lost_on_wire", 0), account["published_count"]
    low, high = wilson(lost, total)
    check(low <= TRUE_LOSS <= high,
          f"{lost} of {total} lost, 95 % interval {100 * low:.2f} to {100 * high:.2f} % "
          "(2 % asked for)")
    check_closing(account)


wifi = summary("wifi")
print("over wlan0:", wifi["run"]["outcome"], wifi["run"]["duration_s"], "s")
radios = {one["channel"]: one for one in wifi["radio"]["channels"]}
for one in wifi["channels"]:
    over_the_radio(one, radios[one["name"]])
stations(wifi["radio"]["hops"])
reports = "".join(path.read_text(encoding="utf-8")
                  for path in (ROOT / "wifi").glob("*/runs/*/report-full.txt"))
check("before the queue" in reports, "the report labels the stamp")

floor, cable = summary("plain"), summary("cable")
print("over a cable, plain and with 5 ms and 2 % loss at each sender:", cable["run"]["outcome"])
for of_floor, one in zip(floor["channels"], cable["channels"], strict=True):
    over_the_cable(of_floor, one)
print("all of it holds" if failures == 0 else f"{failures} of it do not hold")
sys.exit(1 if failures else 0)
