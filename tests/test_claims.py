"""Every figure that the tuner and the certificate claim, from scratch: NumPy and python-control, own hold, own delay.

Only the continuous plant (as control.StateSpace), the coefficients of the two transfer functions and the current per
force are taken from seaopt. The hold is a Taylor series with squaring, the delay is z^-d, stability comes from
python-control's feedback connection, peaks and crossings from a dense grid.
"""

from __future__ import annotations

import itertools

import control
import numpy as np
import pytest

import seaopt as so
from seaopt.robustness.certificate.simulated import STEPS
from tests.checks import leave_out
from tests.words import flatten

LIMITS = {"max_sensitivity": 1.6, "max_complementary": 1.3, "max_reference_peak": 1.3, "max_noise_gain": 60}
F = np.unique(np.r_[np.geomspace(1e-4, 499.9999, 115_000), np.linspace(4, 120, 80_000)])


def held(a, b, ts):
    """exp([[a, b], [0, 0]] ts) by Taylor series, scaling and squaring."""
    n = a.shape[0]
    m = np.zeros((n + 1, n + 1))
    m[:n, :n], m[:n, n] = a * ts / 1024, b * ts / 1024
    term, total = np.eye(n + 1), np.eye(n + 1)
    for k in range(1, 25):
        term = term @ m / k
        total = total + term
    for _ in range(10):
        total = total @ total
    return total[:n, :n], total[:n, n]


class Scratch:
    def __init__(self, controller, plant, params):
        model = plant.linearize(params)
        row = list(plant.outputs).index(controller.spec.measured)
        gain, self.ts = controller.command.per_effort, controller.sample_time_s
        self.a, self.b = held(model.A, model.B[:, 0] * gain, self.ts)
        self.c, self.d = model.C[row], model.D[row, 0] * gain
        self.delay, self.law = controller.compute_delay_samples, controller
        z = np.exp(2j * np.pi * F * self.ts)
        values, vectors = np.linalg.eig(self.a)  # modal form: distinct poles here
        left, right = self.c @ vectors, np.linalg.solve(vectors, self.b)
        p = (left * right / (z[:, None] - values)).sum(axis=1) + self.d
        self.p = p * z**-self.delay
        value = lambda coefficients: sum(v * z**-i for i, v in enumerate(coefficients))  # noqa: E731
        self.cy = value(controller.measurement.num) / value(controller.measurement.den)
        self.cr = value(controller.reference.num) / value(controller.reference.den)
        self.loop = self.p * self.cy
        self.s = 1 / (1 + self.loop)
        self.t = np.abs(self.p * self.cr * self.s)

    def radius(self):
        plant = control.ss(self.a, self.b[:, None], self.c[None], [[self.d]], self.ts)
        law = control.ss(control.tf(self.law.measurement.num, self.law.measurement.den, self.ts))
        late = control.ss(control.tf([1], [1] + [0] * self.delay, self.ts))
        return np.abs(control.feedback(plant * late * law, 1).poles()).max()

    def crossing(self, curve):
        k = np.flatnonzero(np.diff(np.sign(curve)))
        return F[k] - curve[k] * (F[k + 1] - F[k]) / (curve[k + 1] - curve[k])

    def check(self, figures):
        near = lambda value, rel=2e-4: pytest.approx(value, rel=rel)  # noqa: E731
        assert figures.stable
        assert figures.spectral_radius == near(self.radius(), 1e-6)
        assert figures.ms == near(np.abs(self.s).max())
        assert figures.mt == near(np.abs(self.loop * self.s).max())
        assert figures.noise_gain == near(np.abs(self.cy * self.s).max())
        assert figures.reference_peak == near(self.t.max() / self.t[0])
        assert figures.disk_margin == near(2 / np.abs(2 * self.s - 1).max())
        assert figures.bandwidth_hz == near(self.crossing(self.t - self.t[0] / np.sqrt(2))[0], 1e-3)
        slow = self.crossing(np.abs(self.s) - np.sqrt(0.5))
        assert figures.sensitivity_bandwidth_hz == near(slow[0] if abs(self.s[0]) < np.sqrt(0.5) else 0.0, 1e-3)
        self.check_margins(figures)
        self.check_band(figures)

    def check_margins(self, figures):
        at = self.crossing(np.abs(self.loop) - 1)
        assert figures.crossover_hz == pytest.approx(at[-1], rel=1e-3)
        angle = np.angle(-np.interp(at, F, self.loop.real) - 1j * np.interp(at, F, self.loop.imag))
        assert figures.phase_margin_deg == pytest.approx(np.degrees(np.abs(angle).min()), rel=2e-3)
        delay = np.mod(angle, 2 * np.pi) / (2 * np.pi * at)
        assert figures.delay_margin_s == pytest.approx(delay.min(), rel=2e-3)
        turn = self.crossing(self.loop.imag)
        real = np.interp(turn, F, self.loop.real)
        real = np.r_[real[real < 0], self.loop[-1].real if self.loop[-1].real < 0 else []]
        assert figures.gain_margin_db == pytest.approx(np.abs(20 * np.log10(-real)).min(), rel=2e-3)

    def check_band(self, figures):
        inside = np.abs(20 * np.log10(self.t)) < 20 * np.log10(np.sqrt(2))
        edges = np.r_[0, np.flatnonzero(np.diff(inside.astype(int))) + 1, F.size]
        bands = [(F[a] if a else 0.0, F[b - 1]) for a, b in itertools.pairwise(edges) if inside[a]]
        widest = max(bands, key=lambda band: band[1] - band[0])
        assert figures.tracking_band_hz == pytest.approx(widest, rel=2e-3, abs=2e-3)


@pytest.fixture(autouse=True)
def without_steps(monkeypatch):
    """Let certificates have no simulated steps: what is looked at here is linear."""
    leave_out(monkeypatch, STEPS)


@pytest.mark.parametrize(
    ("structure", "bandwidth", "delay"),
    [
        ("pid", 60, 1),
        pytest.param("pd", 45, 2, marks=pytest.mark.slow),
        pytest.param("pid", 30, 1, marks=pytest.mark.slow),
        pytest.param("pd", 15, 1, marks=pytest.mark.slow),
    ],
)
def test_what_the_tuner_and_the_certificate_claim(stand, swing, thor, structure, bandwidth, delay):
    spec = so.ControllerSpec(structure=structure, bandwidth_hz=bandwidth, compute_delay_samples=delay, **LIMITS)
    controller = so.tune(stand, thor, spec, robust_to={"swing": swing})
    certificate = so.certify(
        controller, {"stand": stand, "swing": swing}, thor, ranges={"I_p": (0.3, 0.4)}, samples=50, simulations=False
    )
    design, moving = Scratch(controller, stand, thor), Scratch(controller, swing, thor)
    design.check(controller.achieved)
    for name, plant, scratch in (("stand", stand, design), ("swing", swing, moving)):
        scratch.check(certificate.plants[name])
        worst = certificate.worst[name]
        for witness in (worst.witness, *worst.largest):
            again = Scratch(controller, plant, thor.update(**witness.parameters))
            assert witness.ms == pytest.approx(np.abs(again.s).max(), rel=2e-4)
            assert witness.mt == pytest.approx(np.abs(again.loop * again.s).max(), rel=2e-4)
    if controller.feasible:
        assert max(np.abs(design.s).max(), np.abs(moving.s).max()) <= 1.6
        assert np.abs(design.cy * design.s).max() <= 60
        assert design.t.max() / design.t[0] <= 1.3


def test_the_worst_mt_is_not_that_of_the_plant_with_the_worst_ms(stand, swing, thor):
    """A light motor has the largest Ms, a heavy one the largest Mt: against a grid of plants, each from scratch."""
    lifted = dict.fromkeys(["max_complementary", "max_reference_peak", "max_droop_db", "min_filter_samples"], False)
    spec = so.ControllerSpec(
        bandwidth_hz=40, max_sensitivity=1.7, max_noise_gain=60, reference_weights="error", **lifted
    )
    controller = so.tune(stand, thor, spec, robust_to={"swing": swing})
    ranges = {"J": (1.5e-6, 6e-6), "eta": (0.4, 1.6)}
    certificate = so.certify(controller, {"stand": stand}, thor, ranges=ranges, samples=50, simulations=False)
    worst = certificate.worst["stand"]
    peaks = []
    for inertia, efficiency in itertools.product(np.linspace(*ranges["J"], 4), np.linspace(*ranges["eta"], 4)):
        loop = Scratch(controller, stand, thor.update(J=inertia, eta=efficiency))
        peaks.append((np.abs(loop.s).max(), np.abs(loop.loop * loop.s).max()))
    ms, mt = np.max(peaks, axis=0)
    assert ms * (1 - 1e-4) <= worst.ms <= ms * 1.02
    assert mt * (1 - 1e-4) <= worst.mt <= mt * 1.02
    assert worst.witness.mt < worst.mt
    stored = certificate.to_dict()["plants"]["stand"]["worst"]["largest"]["mt"]
    again = Scratch(controller, stand, thor.update(**stored["parameters"]))
    assert stored["value"] == pytest.approx(np.abs(again.loop * again.s).max(), rel=2e-4)
    assert "largest Mt at" in flatten(repr(certificate))
