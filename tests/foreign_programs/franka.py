"""A Franka robot, played by the package franky-sim, and a controller that moves it with franky-control.

    franka.py robot                     answers at port 1337; counts its cycles in a motion and those in which a
                                        command came
    franka.py controller ROBOT SECONDS  moves a joint there and back; counts the states it was given and, by the
                                        robot's time, how many there were
"""

import os
import subprocess
import sys
import threading
import time

CYCLE_MS = 1
TRAVEL_RAD = 0.15
# More than are made in any run.
MOTION_PAIR_COUNT = 100
CONNECT_S = 60


def robot():
    import franky_sim
    from franky_sim.franka_robot_server import FrankaRobotServer
    from franky_sim.mujoco_simulator import MujocoSimulator

    class Counted(FrankaRobotServer):
        cycle_count = served_count = command_count = state_count = 0

        def _handle_udp_command(self, command):
            self.command_count += 1
            super()._handle_udp_command(command)

        def _post_process_commands(self):
            if self.current_motion_id:
                self.cycle_count += 1
                self.served_count += self._FrankaRobotServer__has_new_command
            super()._post_process_commands()

        def send_state(self):
            self.state_count += self.udp_connected
            super().send_state()

    franky_sim.simulation_server.FrankaRobotServer = Counted
    with MujocoSimulator(enable_visualization=False) as simulator:
        simulator.add_robot()
        with franky_sim.SimulationServer(simulator, hostname_candidates=["10.77.0.2"]) as server:
            one = server.robot_servers[0]
            print("ready", flush=True)

            def tell():
                while True:
                    time.sleep(0.2)
                    print(
                        f"{one.state_count} states sent, {one.command_count} commands received, "
                        f"{one.cycle_count} cycles in motion, {one.served_count} of them with a command",
                        flush=True,
                    )

            threading.Thread(target=tell, daemon=True).start()
            server.run_forever()


def controller(address, seconds):
    subprocess.run([sys.executable, __file__, "motion", address, str(seconds)], check=True)
    # The robot sends no states to one that has left; what is under way arrives, and both have counted to the end.
    time.sleep(1)


def motion(address, seconds):
    import franky

    given, steps = [0], [0.0]

    def count(_state, step, *_rest):
        given[0] += 1
        steps[0] += step.to_msec()

    until = time.monotonic() + CONNECT_S
    while True:
        try:
            one = franky.Robot(address, realtime_config=franky.RealtimeConfig.Ignore)
            break
        except franky.NetworkException:
            if time.monotonic() > until:
                raise
            time.sleep(0.5)
    one.relative_dynamics_factor = 0.3
    # One motion for all the time: where frames are lost, the simulator may take a motion for finished that has just
    # begun, and the controller waits for it for ever.
    home = list(one.current_joint_state.position)
    away = [home[0] + TRAVEL_RAD, *home[1:]]
    there_and_back = [franky.JointWaypoint(away), franky.JointWaypoint(home)]
    moves = franky.JointWaypointMotion(there_and_back * MOTION_PAIR_COUNT)
    moves.register_callback(count)
    one.move(moves, asynchronous=True)
    time.sleep(seconds)
    print(f"{given[0]} states given, {round(steps[0] / CYCLE_MS)} cycles by the robot's time", flush=True)
    # It leaves as it is; the motion would go on.
    os._exit(0)


if sys.argv[1] == "robot":
    robot()
else:
    {"controller": controller, "motion": motion}[sys.argv[1]](sys.argv[2], float(sys.argv[3]))
