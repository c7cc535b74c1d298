"""What modules are like, from bends that cannot be explained: parameters that were put in come out."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.live.modules import BIAS, FILL, GAIN, VENT, ModuleFilter

G, SUPPLY = 1.5e-5, 48e3
SD = np.array([0.12, 0.12, 0.03, 0.15, 0.15, 0.05])


def test_gains_and_biases_come_out_with_their_errors():
    rng = np.random.default_rng(1)
    segments = 200
    true = np.column_stack([1 + 0.12 * rng.normal(size=(segments, 2)), 0.03 * rng.normal(size=segments)])
    modules = ModuleFilter(segments, SD, np.full(5, 1e-4), 0.12)
    rest = 0.05 * rng.normal(size=segments)
    fades = np.exp(-0.02 / 0.12)
    for k in range(600):
        # Both chambers fill and empty, out of step, as under a gait.
        pressure = SUPPLY * (0.5 + 0.5 * np.array([np.sin(0.19 * k), np.sin(0.19 * k + 2.5)]))
        drives = np.tile(G * pressure * [1, -1], (segments, 1))
        modules.advance(0.02)
        rest = fades * rest + 0.05 * np.sqrt(1 - fades**2) * rng.normal(size=segments)
        used = np.zeros((segments, 5))
        used[:, GAIN] = 1.0
        off = ((true[:, :2] - 1) * drives).sum(axis=1) + true[:, 2] + rest
        modules.read_unexplained(off, np.zeros(segments), used, drives, np.tile([G, -G], (segments, 1)))
    sd = np.sqrt(np.einsum("sii->si", modules.covariance))
    for found, spread, given in (
        (modules.mean[:, GAIN], sd[:, GAIN], true[:, :2]), (modules.mean[:, BIAS], sd[:, BIAS], true[:, 2]),
    ):  # fmt: skip
        z = (found - given) / spread
        assert 0.8 < np.sqrt(np.mean(z**2)) < 1.2
    assert np.sqrt(np.mean((modules.mean[:, GAIN] - true[:, :2]) ** 2)) < 0.04


def test_time_constants_come_out_of_pressures():
    tau, true = 0.11, {FILL: 0.2, VENT: -0.15}
    modules = ModuleFilter(1, SD, np.zeros(5), 0.12)
    real = model = np.zeros((1, 2))
    for k in range(400):
        opens = np.array([[float(k // 17 % 2), 1.0 - k // 17 % 2]])

        def after(pressure, fill, vent, opens=opens):
            rate = opens / fill + (1 - opens) / vent
            end = opens * SUPPLY / fill / rate
            return end + (pressure - end) * np.exp(-rate * 0.02)

        real = after(real, tau * np.exp(true[FILL]), tau * np.exp(true[VENT]))
        fill, vent = (tau * np.exp(modules.mean[0, each]) for each in (FILL, VENT))
        model = after(model, fill, vent)
        modules.advance(0.02)
        rates = np.stack([np.full((1, 2), 1 / fill), np.full((1, 2), 1 / vent), np.zeros((1, 2))])
        modules.fill(opens, model, np.array([SUPPLY]), rates, 0.02)
        modules.read_pressures(real - model, np.full((1, 2), 500.0), np.ones((1, 2)))
        model = real.copy()
    for each, value in true.items():
        assert modules.mean[0, each] == pytest.approx(value, abs=0.03)
