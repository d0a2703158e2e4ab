"""A process that simulates a robot commanded over UDP; prints its port, then the result."""

import json
import sys
from dataclasses import asdict
from threading import Event

from symbid_ros.simulation.command import Drives
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import UdpServer


def main(steps: int, options: dict[str, object]) -> None:
    robot = Simulator(SimulateOptions(**options), is_commanded=True)
    drives = Drives(robot.joint_names, robot.drive_names, robot.torque_limits)
    stop, safe, heights, end = Event(), 0, [], "stands"
    # On a busy machine a process may wait longer than the default timeout.
    with UdpServer("127.0.0.1", 0, drives, command_timeout=300.0) as commands:
        print(commands.address[1], flush=True)
        commands.await_controller(stop)
        instant = robot.step()
        try:
            for _ in range(steps):
                command = commands.exchange(instant, stop)
                safe += command.is_safe
                instant = robot.step(command.torques)
                heights.append(instant.base_position[2])
        except RobotFailureError as error:
            end = str(error)
        counts = asdict(commands.counts)
    print(json.dumps({"end": end, "safe": safe, "sunk": heights[0] - min(heights)} | counts))


if __name__ == "__main__":
    main(int(sys.argv[1]), json.loads(sys.argv[2]))
