"""Venting delays of examples/firmware: kills of controller, broker and firmware, and losses of the link.

    uv run --group dev python tools/firmware_kills.py [--kills 60] [--losses 20]
    [--seed 1]

Events come in random order at random times. Kills hit the controller, the broker or the
microcontroller's interpreter (SIGKILL, or a hang or an error in a sensor's driver). A
loss stalls the link for 0.3 to 3 s and then delivers what was sent meanwhile, or it
breaks the connection. Delays are counted from the expiry of the command that was obeyed
last, 0.2 s after it was sent. Exits with 1 where a delay exceeds its bound.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from brokers import wait
from firmware_rig import HOLD_S, WATCHDOG_S, Cause, Rig, Vent

BOUND_S = 0.2
KILLS = ("controller", "broker", "interpreter", "hang", "error")
LOSSES = ("stall", "cut")


@dataclass
class Study:
    """Outcome of a session with kills and losses.

    Attributes:
        events: kind of event → number.
        vents: all times at which the chambers were vented.
        resets: number of resets by the watchdog.
        oldest: largest age of a command at the time at which the valves were set for
            it, s.
    """

    events: Counter[str]
    vents: list[Vent]
    resets: int
    oldest: float

    @property
    def of_loop(self) -> np.ndarray:
        """Delays after the command's expiry while the loop ran, s."""
        return np.array(
            [vent.delay for vent in self.vents if vent.cause is Cause.EXPIRY]
        )

    @property
    def of_errors(self) -> np.ndarray:
        """Delays after the command's expiry where the loop ended by an error, s; negative before it."""
        return np.array(
            [vent.delay for vent in self.vents if vent.cause is Cause.ERROR]
        )

    @property
    def of_resets(self) -> np.ndarray:
        """Delays of resets after the watchdog was fed last, s."""
        return np.array(
            [vent.time - vent.fed for vent in self.vents if vent.cause is Cause.RESET]
        )

    @property
    def late(self) -> bool:
        """Whether a delay exceeds its bound; the rig polls the watchdog, which adds up to 0.1 s."""
        return bool(
            (self.of_loop >= BOUND_S).any()
            or (self.of_errors >= BOUND_S).any()
            or (self.of_resets >= WATCHDOG_S + 0.1).any()
            or self.oldest >= HOLD_S + BOUND_S
        )

    def table(self) -> str:
        """Return events and delays as a table."""
        lines = [
            "events: "
            + ", ".join(
                f"{count} {kind}" for kind, count in sorted(self.events.items())
            ),
            f"resets: {self.resets}",
            f"{'chambers vented':<44}{'times':>6}{'95 %':>8}{'largest':>9}   s",
        ]
        for name, delays in (
            ("by the loop, after the command's expiry", self.of_loop),
            ("after an error, after the command's expiry", self.of_errors),
            ("by a reset, after the watchdog's last feed", self.of_resets),
        ):
            if len(delays):
                lines.append(
                    f"{name:<44}{len(delays):>6}{np.quantile(delays, 0.95):>8.3f}{delays.max():>9.3f}"
                )
        lines.append(f"{'oldest command that was obeyed':<58}{self.oldest:>9.3f}")
        return "\n".join(lines)


def study(folder: Path, *, kills: int, losses: int, seed: int) -> Study:
    """Run a robot through kills and losses in random order."""
    draw = random.Random(seed)
    events = [draw.choice(KILLS) for _ in range(kills)] + [
        draw.choice(LOSSES) for _ in range(losses)
    ]
    draw.shuffle(events)
    with Rig(folder) as rig:
        for event in events:
            wait(lambda: rig.robot.filling, 30)
            time.sleep(draw.uniform(0.0, 0.7))
            happen(rig, event, draw)
        wait(lambda: rig.robot.filling, 30)
        rig.controller.kill()
        wait(lambda: not rig.robot.filling)
        time.sleep(0.1)
        return Study(Counter(events), rig.vents(), len(rig.robot.resets), rig.oldest())


def happen(rig: Rig, event: str, draw: random.Random) -> None:
    """Cause an event, then restart the process that it killed."""
    if event == "controller":
        rig.controller.kill()
        time.sleep(draw.uniform(0.0, 1.0))
        rig.controller.start()
    elif event == "broker":
        rig.broker.kill()
        time.sleep(draw.uniform(0.0, 1.0))
        rig.broker.start()
    elif event == "interpreter":
        rig.robot.kill()
    elif event == "stall":
        rig.wire.stalled = True
        time.sleep(draw.uniform(0.3, 3.0))
        rig.wire.stalled = False
    elif event == "cut":
        rig.wire.cut()
    else:
        rig.robot.fault(event)
    if event in ("interpreter", "hang", "error"):
        resets = len(rig.robot.resets)
        wait(lambda: len(rig.robot.resets) > resets)


def main() -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--losses", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = study(
            Path(folder), kills=options.kills, losses=options.losses, seed=options.seed
        )
    print(result.table())
    return int(result.late)


if __name__ == "__main__":
    sys.exit(main())
