"""A KUKA robot with RSI, played by the package RSIPI, and a sensor that answers it.

    rsi.py robot SENSOR SECONDS    RSIPI's EchoServer: a packet every cycle of 4 ms, and its own count of the
                                   cycles that were answered late or not at all
    rsi.py sensor                  sends each packet's IPOC back to where it came from
"""

import re
import socket
import sys
import time
from pathlib import Path

import RSIPI
from RSIPI.rsi_echo_server import EchoServer

CONFIG = Path(RSIPI.__file__).parent / "contexts" / "RSI_EthernetConfig_Basic.xml"
CYCLE_MS = 4
# Of faulty packets, after which a robot stops; all of a test are to be counted.
TIMEOUT_PACKETS = 1_000_000


def robot(sensor, seconds):
    server = EchoServer(str(CONFIG), delay_ms=CYCLE_MS, timeout_packets=TIMEOUT_PACKETS)
    # The server looks for the sensor on its own host.
    server.client_address = (sensor, server.client_address[1])
    server.start()
    time.sleep(seconds)
    server.stop()
    sent = (server.ipoc_value - server.first_ipoc) // server.ipoc_increment
    print(f"{sent} packets sent, {server.faulty_packets} faulty", file=sys.stderr)


def sensor():
    text = CONFIG.read_text()
    port, kind = (re.search(f"<{key}>(.*?)</{key}>", text)[1] for key in ("PORT", "SENTYPE"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("", int(port)))
        while True:
            packet, sender = one.recvfrom(65_535)
            ipoc = re.search(rb"<IPOC>(\d+)</IPOC>", packet)[1].decode()
            one.sendto(f'<Sen Type="{kind}"><IPOC>{ipoc}</IPOC></Sen>'.encode(), sender)


if sys.argv[1] == "robot":
    robot(sys.argv[2], float(sys.argv[3]))
else:
    sensor()
