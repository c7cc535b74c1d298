"""`srs-twin play`: steer a robot's twin by keys."""

from __future__ import annotations

from srs_twin.cli.options import RobotArgument


def play(
    robot: RobotArgument,
) -> None:
    """Steer the twin of a robot live, in MuJoCo's viewer.

    Keys: arrows, page up and page down.
    """
    from srs_twin.robot.spec import load_robot

    spec = load_robot(robot)
    from srs_twin.viewing.mujoco.live import MujocoWindow, refuse_without_display

    refuse_without_display()
    from srs_twin.viewing.mujoco.live import LiveSnake, steer

    snake = LiveSnake(spec)
    with MujocoWindow(snake) as window:
        steer(snake, window)
