#!/bin/sh
# Mosquitto's clients: one publishes the numbers from 1 to $2 to the broker at $1, the other is to receive them all, in
# order. Then what the kernel counts of TCP in this network.
set -u
sleep 1
mosquitto_sub -h "$1" -t numbers -q 1 -C "$2" -W 100 >received.txt &
subscriber=$!
sleep 1
seq -f "%0200.0f" 1 "$2" >sent.txt
mosquitto_pub -h "$1" -t numbers -q 1 -l <sent.txt || exit 1
wait "$subscriber" || exit 1
cmp sent.txt received.txt || exit 1
# Until both connections have ended.
sleep 1
segments="$(grep ^Tcp: /proc/net/snmp | tail -n 1 | cut -d ' ' -f 13)"
echo "$(wc -l <received.txt) messages received in order, $segments segments sent again"
