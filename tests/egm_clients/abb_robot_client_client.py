"""Drives the robot model with the package abb_robot_client: one answer per message of the robot."""

import sys

from abb_robot_client.egm import EGM

import swing


def receive(egm, timeout_s):
    """The oldest waiting message of the robot."""
    return egm.receive_from_robot(timeout=timeout_s)


def send(egm, joints, external):
    """A joint target in degrees."""
    return egm.send_to_robot(joints, external_joints=external)


if __name__ == "__main__":
    given = swing.arguments(__doc__)
    sys.exit(swing.run(EGM(port=given.port), receive, send, given))
