"""Live twins with too little processor time: time to obey, lost part of the journal, and warnings.

    uv run python tools/live_shortage.py [--fractions 0.1 0.2 0.5] [--seconds 120]

An emulated robot obeys a gait, and live twins listen to it. The processor time per
second that one of them needs is measured first. Then three of them get a share of it: a
process that has used its fraction is stopped until it may use more. At the end one gets
SIGKILL, one SIGTERM and one the word `stop`. Needs mosquitto.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import paho.mqtt.client as mqtt

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from brokers import Broker, free_port
from common.grid import table

from srs_twin import Gait, load_robot
from srs_twin.live.journal import journal_messages
from srs_twin.live.messages import COMMAND, CONTROL, encode, topic

SRS_TWIN = str(Path(sys.executable).with_name("srs-twin"))
ROBOT = "gen4"
TICK_S = 0.02
PERIOD_S = 0.1  # longest time for which unused processor time can be saved
CHECK_S = 0.003
START_S = 30.0  # compiling, learning the clocks
MEASURE_S = 20.0
PATIENCE_S = 120.0


def walk(client: mqtt.Client, ended: threading.Event) -> None:
    """Publish the commands of a gait every tick."""
    gait = Gait(1.0)
    gait.reset(load_robot(ROBOT), TICK_S)
    begin = time.monotonic()
    while not ended.wait(TICK_S):
        now = time.monotonic()
        valves = gait.valves_at(now - begin)
        first_slot = valves.reshape(-1, *valves.shape[-2:])[0]
        client.publish(topic(ROBOT, COMMAND), encode(COMMAND, now, first_slot))


@contextlib.contextmanager
def walking_robot(folder: Path) -> Iterator[tuple[mqtt.Client, list[str]]]:
    """Run a broker and an emulated robot under a gait; yield a client and the options of a live twin."""
    with Broker(folder) as broker:
        options = [
            "--mqtt",
            f"127.0.0.1:{broker.port}",
            "--natnet",
            f"127.0.0.1:{free_port()}",
        ]
        emulator = subprocess.Popen([SRS_TWIN, "emulate", ROBOT, *options, "--quiet"])
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.connect("127.0.0.1", broker.port)
        client.loop_start()
        ended = threading.Event()
        walker = threading.Thread(target=walk, args=(client, ended))
        walker.start()
        try:
            yield client, options
        finally:
            ended.set()
            walker.join()
            client.loop_stop()
            emulator.terminate()
            emulator.wait()


class Listener:
    """Live twin in a process of its own, which can get less processor time than it needs.

    Attributes:
        folder: its output folder.
        process: its process.
    """

    def __init__(self, folder: Path, options: list[str]) -> None:
        folder.mkdir()
        self.folder = folder
        self._printed = (folder / "printed.txt").open("wb")
        command = [SRS_TWIN, "shadow", ROBOT, *options, "--out", str(folder / "out")]
        self.process = subprocess.Popen(
            command, stdout=self._printed, stderr=subprocess.STDOUT
        )

    def processor_time(self) -> float:
        """Return the processor time of its threads so far, s."""
        threads = Path(f"/proc/{self.process.pid}/task").glob("*/schedstat")
        return 1e-9 * sum(int(thread.read_text().split()[0]) for thread in threads)

    def throttle(self, fraction: float) -> None:
        """Allow only this share of a core from now on."""
        threading.Thread(target=self._limit, args=(fraction,), daemon=True).start()

    def _limit(self, fraction: float) -> None:
        """Stop the process whenever it has used its fraction, and continue it later."""
        began = time.monotonic()
        used = self.processor_time()
        with contextlib.suppress(ProcessLookupError, FileNotFoundError):
            while self.process.poll() is None:
                due = (
                    self.processor_time() - used - fraction * (time.monotonic() - began)
                )
                # A process that did not get its share, because the machine is busy,
                # does not get it later.
                used += min(due + fraction * PERIOD_S, 0.0)
                os.kill(self.process.pid, signal.SIGSTOP if due > 0 else signal.SIGCONT)
                time.sleep(CHECK_S)

    def warnings(self) -> str:
        """Return the warnings about a slow machine."""
        text = (self.folder / "printed.txt").read_text("utf-8", "replace")
        lines = [
            line
            for line in re.split(r"[\r\n]+", text)
            if re.search(r"skip|behind|too_old|slow", line)
        ]
        return "; ".join(dict.fromkeys(lines)) or "–"

    def last_arrival(self) -> float:
        """Return when the last message of the journal arrived, s."""
        (journal,) = self.folder.rglob("*.mcap")
        return max(message.arrived for message in journal_messages(journal, ROBOT, 4))


def time_to_obey(listener: Listener, asked: float) -> str:
    """Return after which time a live twin stopped listening and its process ended.

    Args:
        listener: live twin that was asked to end.
        asked: when it was asked, s.
    """
    try:
        listener.process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        listener.process.kill()
        return f"more than {PATIENCE_S:.0f} s"
    ended = time.monotonic() - asked
    return f"{listener.last_arrival() - asked:.2f} s; {ended:.1f} s"


def main() -> None:
    """Print one row for each fraction."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fractions", type=float, nargs="+", default=[0.1, 0.2, 0.5])
    parser.add_argument("--seconds", type=float, default=120.0)
    given = parser.parse_args()
    rows = []
    with (
        tempfile.TemporaryDirectory() as name,
        walking_robot(Path(name)) as (client, options),
    ):
        for fraction in given.fractions:
            listeners = [
                Listener(Path(name) / f"{fraction}-{end}", options)
                for end in ("kill", "term", "stop")
            ]
            killed, terminated, stopped = listeners
            time.sleep(START_S)
            used = killed.processor_time()
            time.sleep(MEASURE_S)
            need = (killed.processor_time() - used) / MEASURE_S
            for listener in listeners:
                listener.throttle(fraction * need)
            time.sleep(given.seconds)
            killed.process.kill()
            death = time.monotonic()
            killed.process.wait()
            lost = death - killed.last_arrival()
            terminated.process.terminate()
            after_signal = time_to_obey(terminated, time.monotonic())
            client.publish(topic(ROBOT, CONTROL), b"stop")
            after_word = time_to_obey(stopped, time.monotonic())
            warnings = stopped.warnings()
            rows.append(
                [
                    f"{fraction:g} of {need:.2f}",
                    after_word,
                    after_signal,
                    f"{lost:.2f} s",
                    warnings,
                ]
            )
            print(rows[-1], flush=True)
    print(
        table(
            [
                "processor",
                "`stop`: obeyed; ended",
                "SIGTERM: obeyed; ended",
                "journal lost",
                "warnings",
            ],
            rows,
        )
    )


if __name__ == "__main__":
    main()
