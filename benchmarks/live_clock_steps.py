"""Steps of a sender's clock while a live twin steers a robot.

    uv run python benchmarks/live_clock_steps.py [--seed 700] [--after 4]

A robot of generation 2 follows a plan. After five seconds one sender's stamps are wrong
by a step, in one message or in all later ones: the robot's, the cameras', or the
controller's. Stated are the longest time without a used message of the sender and the
share of ticks in which the robot is vented. Robot and messages: `live_runs`.
"""

from __future__ import annotations

import argparse
import copy
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from grid import table

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import Run, Wire

from srs_twin import load_robot, load_scenario
from srs_twin.live.commands import SILENT_S
from srs_twin.live.messages import BENDS, COMMAND, POSES, PRESSURES, VALVES, Message
from srs_twin.live.shadow import Shadow
from srs_twin.live.steering import EstimateSteering

KINDS = {
    "robot": (BENDS, PRESSURES, VALVES),
    "cameras": (POSES,),
    "controller": (COMMAND,),
}
STEPS_S = (0.1, 0.3, 0.9, 1.5, 5.0)
BEFORE_S = 5.0
SCENARIO = "follow_orifice"


@dataclass(frozen=True)
class Step:
    """A wrong stamp.

    Attributes:
        sender: one of `KINDS`; empty: none is wrong.
        seconds: added to the stamps, s.
        lasts: whether all later messages have it, or only one.
    """

    sender: str = ""
    seconds: float = 0.0
    lasts: bool = False


class SteeredRobot:
    """A robot that is steered by its live twin in simulated time."""

    def __init__(self, seed: int) -> None:
        scenario = load_scenario(SCENARIO)
        self._run = Run(seed, 60.0, robot="gen2", frequency=2.0)
        self._robot = self._run.emulated(start=scenario.pose)
        self._wire = Wire(self._run)
        self.twin = Shadow(
            load_robot("gen2"), seed=seed, supply_pa=self._robot.supply_pa
        )
        self.steering = EstimateSteering(scenario, self.twin, self._robot.tick)
        self._command = None
        self._heard = -1.0
        self.time = 0.0
        self.vented_ticks = 0
        self.ticks = 0
        self.step: Step | None = None
        self.used: list[float] = []
        """Times at which messages of the sender with the step were used, s."""
        self.faults: set[str] = set()

    def proceed(self, seconds: float) -> None:
        """Steer for a time (s), or until the steering ends."""
        end = self.time + seconds
        while self.time < end - 1e-9 and not self.steering.finished:
            self._tick()

    def _tick(self) -> None:
        self._robot.step(self._command if self.time - self._heard <= SILENT_S else None)
        self.time += self._robot.tick
        self._wire.tell(self._robot, self.time)
        messages = [self._stamped(message) for message in self._wire.arrived(self.time)]
        for message in messages:
            if message.kind == COMMAND:
                self._command = message.values
                self._heard = self.time
        before = dict(self.twin.buffer.counts)
        estimate = self.twin.update(self.time, messages)
        if estimate is not None:
            self.faults |= {f"{part}: {fault}" for part, fault, _ in estimate.faults}
        self._note_use(before)
        command = self.steering.step(estimate, self.twin)
        self.vented_ticks += bool((command == -1).all())
        self.ticks += 1
        self._wire.send(COMMAND, self._run.robot, self.time, command)

    def _stamped(self, message: Message) -> Message:
        """Return a message with the step, if it is due."""
        step = self.step
        if step is None or message.kind not in KINDS.get(step.sender, ()):
            return message
        if not step.lasts:
            self.step = replace(step, seconds=0.0)
        return replace(message, sent=message.sent + step.seconds)

    def _note_use(self, before: dict[tuple[str, str, str], int]) -> None:
        if self.step is None:
            return
        kinds = KINDS.get(self.step.sender, KINDS["robot"])
        for (source, kind, result), count in self.twin.buffer.counts.items():
            if (
                kind in kinds
                and result == "taken"
                and count > before.get((source, kind, result), 0)
            ):
                self.used.append(self.time)
                return


def measured(robot: SteeredRobot, after_s: float, step: Step) -> list[str]:
    """Return a row of the table for one step."""
    robot = copy.deepcopy(robot)
    robot.step = step
    robot.vented_ticks = 0
    robot.ticks = 0
    begin = robot.time
    robot.proceed(after_s)
    gap = np.diff([begin, *robot.used, robot.time]).max()
    uncertain = max(clock.uncertainty for clock in robot.twin.buffer.clocks.values())
    return [
        step.sender or "none",
        f"{step.seconds:+g}",
        "all later" if step.lasts else "one",
        f"{gap:.2f}",
        f"{100 * robot.vented_ticks / robot.ticks:.0f}",
        f"{uncertain:.2f}",
        robot.steering.summary()["ending"] if robot.steering.finished else "steered",
        ", ".join(sorted(robot.faults)) or "–",
    ]


def main() -> None:
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seed", type=int, default=700)
    words.add_argument(
        "--after", type=float, default=4.0, metavar="S", help="time after the step"
    )
    options = words.parse_args()
    robot = SteeredRobot(options.seed)
    robot.proceed(BEFORE_S)
    steps = [Step()] + [
        Step(sender, sign * seconds, lasts)
        for sender in KINDS
        for lasts in (False, True)
        for seconds in STEPS_S
        for sign in (1, -1)
    ]
    with ProcessPoolExecutor() as pool:
        rows = list(pool.map(partial(measured, robot, options.after), steps))
    head = [
        "sender",
        "step, s",
        "messages",
        "longest gap, s",
        "vented ticks, %",
        "uncertain age, s",
        "session",
        "faults",
    ]
    print(table(head, rows))


if __name__ == "__main__":
    main()
