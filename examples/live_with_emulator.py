"""Run a live twin beside an emulated robot, in simulated time and without a broker.

    python examples/live_with_emulator.py

`srs-twin emulate` and `srs-twin shadow` connect the same two objects over MQTT and
motion capture. A valve of the robot gets stuck after two seconds.
"""

import math

import numpy as np

import srs_twin as srs
from srs_twin.live.emulator import EmulatedRobot
from srs_twin.live.messages import BENDS, COMMAND, POSES, PRESSURES, Message
from srs_twin.live.shadow import Shadow

DELAY_S = 0.005


def heard(robot: EmulatedRobot, command: np.ndarray, time: float) -> list[Message]:
    """Return the messages of one tick: command, sensors, and motion capture."""
    bodies = {f"connector_{i}": body for i, body in robot.bodies().items()}
    poses = []
    for body in bodies.values():
        x, up, back = body.place  # the y axis of motion capture points up
        poses.append([x, -back, up, 2 * math.atan2(body.turn[1], body.turn[3])])
    values = {COMMAND: command, BENDS: robot.bends(), PRESSURES: robot.state.pressure}
    arrived = time + DELAY_S
    messages = [Message(k, "gen4", time, arrived, v) for k, v in values.items()]
    seen = np.array(poses)
    return [*messages, Message(POSES, "camera", time, arrived, seen, (*bodies,))]


def main() -> None:
    """Print the detected fault, and the error of the estimated position."""
    robot = EmulatedRobot("gen4", seed=3, faults=["stuck_valve:2+@2"])
    shadow = Shadow(srs.load_robot("gen4"), members=24)
    gait = srs.Gait(1.5)
    gait.reset(robot.twin.spec, robot.tick)
    named: set[str] = set()
    for tick in range(300):
        time = tick * robot.tick
        command = gait.valves_at(time)
        # The edges of the gait fall inside ticks; the robot gets the last state.
        command = command[-1] if command.ndim == 3 else command
        messages = heard(robot, command, time)
        robot.step(command)
        estimate = shadow.update(time + robot.tick, messages)
        for fault in estimate.faults if estimate else ():
            if fault.name not in named:
                named.add(fault.name)
                print(f"{robot.state.time:.2f} s: {fault.part}, {fault.name}")
    error = 1e3 * np.hypot(*(estimate.pose[:2] - robot.state.com))
    print(f"after {robot.state.time:.0f} s the position is off by {error:.1f} mm")


if __name__ == "__main__":
    main()
