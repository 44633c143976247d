"""What strains a cable: two programs, each with more to send than is carried, or to more ends than are told apart.

    stress.py storm OTHER SECONDS [asks]  broadcasts and multicasts as fast as the socket takes them; then, with
                                          `asks`, 100 requests that the other one answers until it is ended
    stress.py from_ports OTHER COUNT      two datagrams from each of COUNT ports; ends once the other one is done
    stress.py to_ports OTHER COUNT        two datagrams to each of COUNT ports
    stress.py talk OTHER SECONDS [downs]  a datagram every 5 ms three times SECONDS long; with `downs`, its interface
                                          is set down for the second time

What each counted stands in the last line of what it says.
"""

import select
import socket
import subprocess
import sys
import time

STORM_PORT = 5000
ECHO_PORT = 5001
DONE_PORT = 5002
GROUP = "239.255.0.1"
PAYLOAD = b"x" * 64
REQUEST_COUNT = 100
# Between batches of datagrams that none may be lost of.
BATCH_COUNT = 20
PAUSE_S = 0.005
FIRST_PORT = 20_000


def datagrams(port=0):
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    one.bind(("", port))
    return one


def storm(other, seconds, asks):
    network = other.rsplit(".", 1)[0]
    own = f"{network}.{3 - int(other[-1])}"
    echoes, storming = datagrams(ECHO_PORT), datagrams(STORM_PORT)
    storming.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
    storming.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(own))
    storming.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)
    membership = socket.inet_aton(GROUP) + socket.inet_aton(own)
    storming.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
    meet(echoes, other)
    counts, until = [0, 0], time.monotonic() + seconds
    targets = [(f"{network}.255", STORM_PORT), (GROUP, STORM_PORT)]
    while time.monotonic() < until:
        for _ in range(32):
            for index, target in enumerate(targets):
                try:
                    storming.sendto(PAYLOAD, target)
                    counts[index] += 1
                except OSError:
                    time.sleep(0.0001)
    said = f"{counts[0]} broadcasts sent, {counts[1]} multicasts sent"
    print(said, file=sys.stderr, flush=True)
    if not asks:
        while True:
            request, sender = echoes.recvfrom(2048)
            echoes.sendto(request, sender)
    answered_count = ask(other)
    print(f"{said}, {answered_count} answered", file=sys.stderr)


def meet(one, other):
    """Both go on at the same moment, once each has heard the other."""
    has_heard = False
    while not has_heard:
        one.sendto(b"there", (other, ECHO_PORT))
        has_heard = bool(select.select([one], [], [], 0.1)[0])
    one.sendto(b"there", (other, ECHO_PORT))
    time.sleep(0.2)
    while select.select([one], [], [], 0)[0]:
        one.recv(2048)


def ask(other):
    # What the storm left in queues is still in front of the first ones.
    one, number = datagrams(), 0
    is_over = False
    while not is_over:
        number += 1
        is_over = is_answered(one, other, number)
    answered = [is_answered(one, other, number + 1 + index) for index in range(REQUEST_COUNT)]
    return sum(answered)


def is_answered(one, other, number):
    request = str(number).encode()
    one.sendto(request, (other, ECHO_PORT))
    until = time.monotonic() + 2
    while time.monotonic() < until:
        if select.select([one], [], [], max(until - time.monotonic(), 0))[0] and one.recv(2048) == request:
            return True
    return False


def ports(other, count, of_source):
    done = datagrams(DONE_PORT)
    # None of them is in use, and none is open at the other end.
    one, sent_count = datagrams(), 0
    for _ in range(2):
        for port in range(FIRST_PORT, FIRST_PORT + count):
            if of_source:
                with datagrams(port) as source:
                    source.sendto(PAYLOAD, (other, STORM_PORT))
            else:
                one.sendto(PAYLOAD, (other, port))
            sent_count += 1
            if sent_count % BATCH_COUNT == 0:
                time.sleep(PAUSE_S)
    print(f"{sent_count} datagrams sent", file=sys.stderr, flush=True)
    done.settimeout(0.2)
    has_ended = False
    while not has_ended:
        done.sendto(b"done", (other, DONE_PORT))
        try:
            has_ended = done.recv(2048) == b"done"
        except TimeoutError:
            pass
    if not of_source:
        while True:
            done.sendto(b"done", (other, DONE_PORT))
            time.sleep(0.2)


def talk(other, seconds, downs):
    one = datagrams(STORM_PORT)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_000_000)
    one.setblocking(False)
    meet(datagrams(ECHO_PORT), other)
    counts = {"sent": 0, "refused": 0, "received": 0}

    def receive():
        while select.select([one], [], [], 0)[0]:
            one.recv(2048)
            counts["received"] += 1

    def set_interface(state):
        if downs:
            subprocess.run(["ip", "link", "set", "eth0", state], stderr=sys.stderr)

    for state in ("down", "up", None):
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            try:
                one.sendto(PAYLOAD, (other, STORM_PORT))
                counts["sent"] += 1
            except OSError:
                counts["refused"] += 1
            time.sleep(PAUSE_S)
            receive()
        if state:
            set_interface(state)
    until = time.monotonic() + 1
    while time.monotonic() < until:
        time.sleep(PAUSE_S)
        receive()
    print(", ".join(f"{count} {what}" for what, count in counts.items()), file=sys.stderr, flush=True)
    # The run ends with the one that sets its interface down.
    time.sleep(1 if downs else 3600)


role, other, number = sys.argv[1:4]
if role == "storm":
    storm(other, float(number), "asks" in sys.argv[4:])
elif role == "talk":
    talk(other, float(number), "downs" in sys.argv[4:])
else:
    ports(other, int(number), role == "from_ports")
