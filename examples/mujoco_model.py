"""Drive an exported model in MuJoCo, without srs_twin.

    srs-twin models export gen2 --out models
    python examples/mujoco_model.py models/gen2/scene.xml

The controls are the gauge pressures of the two chambers of each segment, Pa. They
follow a travelling wave here; real chambers fill and vent by a law that is not in the
model.
"""

import sys

import mujoco
import numpy as np

FREQUENCY_HZ = 1.0
PEAK_PA = 30e3
PHASE_STEP_RAD = np.pi / 2
"""Phase between neighbouring segments."""


def main() -> None:
    """Print the distance that the centre of mass covers in three periods."""
    model = mujoco.MjModel.from_xml_path(sys.argv[1])
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    names = [model.actuator(i).name for i in range(model.nu)]
    segments = sum(name.startswith("plus_") for name in names)
    plus = [names.index(f"plus_{j + 1}") for j in range(segments)]
    minus = [names.index(f"minus_{j + 1}") for j in range(segments)]
    phases = PHASE_STEP_RAD * np.arange(segments)

    mujoco.mj_forward(model, data)
    start = data.subtree_com[0, :2].copy()
    while data.time < 3 / FREQUENCY_HZ:
        wave = PEAK_PA * np.sin(2 * np.pi * FREQUENCY_HZ * data.time - phases)
        # The pressure rises over the first half period.
        wave *= min(1.0, 2 * FREQUENCY_HZ * data.time)
        data.ctrl[plus] = np.maximum(wave, 0.0)
        data.ctrl[minus] = np.maximum(-wave, 0.0)
        mujoco.mj_step(model, data)
    covered = np.hypot(*(data.subtree_com[0, :2] - start))
    print(
        f"{segments} segments, {model.nu} controls, {1e3 * covered:.0f} mm in 3 periods"
    )


if __name__ == "__main__":
    main()
