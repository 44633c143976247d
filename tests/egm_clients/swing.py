"""What both clients do with the robot: a sine per joint around where the robot stands.

Not a test by itself: abb_robot_egm_client.py and abb_robot_client_client.py drive it, each with the
package it is named after, because both packages define the same protobuf messages and cannot be
imported into one process.
"""

import argparse
import math
import sys
import time

# Amplitudes grow from nothing over this long: EGM limits how far a reference may jump.
RAMP_S = 2.0
# As long as the packages' own examples wait for a robot before they give up, and ten times more.
PATIENCE_S = 5.0


def arguments(description):
    """The command line of both clients."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--port", type=int, required=True, help="UDP port the robot sends to")
    parser.add_argument("--period", type=float, default=4.0, help="of the sine, seconds")
    parser.add_argument(
        "--amplitudes",
        required=True,
        help="degrees, comma-separated in wire order: J1 to J6, then J7 as the external axis",
    )
    given = parser.parse_args()
    given.amplitudes = [float(text) for text in given.amplitudes.split(",")]
    return given


class Swing:
    """Joint targets over time; robot joints and external axes apart, in degrees."""

    def __init__(self, period_s, amplitudes_deg):
        self.period_s = period_s
        self.amplitudes_deg = amplitudes_deg
        self.start = None

    def targets(self, joints_deg, external_deg, now_s):
        """Where to be at now_s; the first call says where to swing around."""
        if self.start is None:
            self.start = (now_s, [*joints_deg, *external_deg])
        began_s, centre = self.start
        elapsed_s = now_s - began_s
        share = min(elapsed_s / RAMP_S, 1.0)
        wave = share * math.sin(2.0 * math.pi * elapsed_s / self.period_s)
        moved = [
            middle + amplitude * wave
            for middle, amplitude in zip(centre, self.amplitudes_deg, strict=False)
        ]
        return moved[:6], moved[6:]


def run(egm, receive, send, given):
    """Answers every message of the robot until the robot is silent for too long."""
    swing = Swing(given.period, given.amplitudes)
    answered = 0
    while True:
        success, state = receive(egm, PATIENCE_S)
        if not success:
            print(f"no robot for {PATIENCE_S} s after {answered} answers", file=sys.stderr)
            return 0 if answered else 1
        axes = [] if state.external_axes is None else list(state.external_axes)
        joints, external = swing.targets(list(state.joint_angles), axes, time.monotonic())
        if send(egm, joints, external or None):
            answered += 1
