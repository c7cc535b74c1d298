"""`srs-twin play`: steer a robot's twin by keys."""

from __future__ import annotations

from typing import Annotated

from srs_twin.cli.options import ChangeOptions, RobotArgument, option
from srs_twin.errors import InputError


def play(
    robot: RobotArgument,
    change: Annotated[list[str] | None, option("--set FIELD=VALUE")] = None,
) -> None:
    """Steer the twin of a robot live, in MuJoCo's viewer.

    Keys: arrows, page up and page down.

    Options:
        change: Another value of a field, as robot.friction.mu_t=0.1; repeatable.
    """
    from srs_twin.io.documents import Document
    from srs_twin.robot.file import resolve_robot

    document = Document(robot, {"robot": robot})
    for each in ChangeOptions(change).changes():
        if each.loc[0] != "robot":
            raise InputError(f"{each.words}: play has no scenario; set a field of robot")
        document.change(each)
    found = resolve_robot(document, document.get("robot"), prefix=("robot",))
    document.finish()
    assert found is not None, "a robot without a problem was resolved"
    from srs_twin.viewing.mujoco.live import MujocoWindow, refuse_without_display

    refuse_without_display()
    from srs_twin.viewing.mujoco.live import LiveSnake, steer

    snake = LiveSnake(found.spec())
    with MujocoWindow(snake) as window:
        steer(snake, window)
