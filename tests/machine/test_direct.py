"""The plant from command and readings alone, beside that from the reference, against the closed form of its bias."""

from __future__ import annotations

import json

import numpy as np
import pytest

import seaopt as so
from seaopt.files import to_json
from seaopt.machine.response.periods import Blocks, LeftOut
from seaopt.machine.response.verdicts import measure
from seaopt.machine.wording import say_bias
from tests.machine.simulator import Machine, multisine
from tests.machine.test_response import LINES, respond

PERIOD, PERIODS, FINE = 1000, 200, 16  # FINE: of the grid, in a line
WAVE = multisine(PERIOD, LINES, PERIODS, 20.0, 3, bias=300.0)


def window(density):
    """Return the mean of a period's product of two signals of this cross spectrum: what leaks from line to line of
    noise that does not repeat weighs its covariance with 1 - |k|/N.
    """
    covariance = np.fft.irfft(density)
    k = np.minimum(np.arange(covariance.size), covariance.size - np.arange(covariance.size))
    return np.fft.rfft(covariance * np.maximum(1.0 - k / PERIOD, 0.0))[::FINE]


def expect(controller, f, noise):
    """Return the plant, and to what the direct estimate tends: a mean of the plant, weighted with the reference's
    share of U = S (C_r R - C V), and of -1/C, with the noise's, where Y = S (P C_r R + V), V white. Besides, the
    noise's share.
    """
    fine = np.arange(FINE * PERIOD // 2 + 1) / (FINE * PERIOD) * 1e3
    fine[0] = 1e-3  # an integral has no response at zero
    loop, tracking = respond(Machine(), fine, controller, 1)
    feedback = -controller.law.responses(fine)[1]
    spread = 4.0 * noise**2 / PERIOD * np.abs(1.0 / (1.0 + loop)) ** 2  # of a line of white noise, by S
    lines = np.round(f * PERIOD * 1e-3).astype(int)
    of_effort, cross = (window(each)[lines] for each in (np.abs(feedback) ** 2 * spread, -np.conj(feedback) * spread))
    plant = (loop / feedback)[::FINE][lines]
    reference = np.abs(2.0 / PERIOD * np.fft.rfft(WAVE[:PERIOD])[lines] * tracking[::FINE][lines] / plant) ** 2
    total = reference + np.real(of_effort)
    return plant, (plant * reference + cross) / total, np.real(of_effort) / total


def test_the_direct_estimate_is_biased_as_its_closed_form_says_and_the_joint_one_holds_the_plant(controller, bench):
    noise = 8.0
    result = so.accept(controller, [bench.log(Machine(), WAVE, noise=noise)])
    (part,) = result.response.measured
    plant, limit, share = expect(controller, part.f, noise)
    std = np.abs(limit - plant) / np.sqrt(share * part.periods)  # of the mean of so many periods
    assert np.max(np.abs(limit / plant - 1.0)) > 0.1  # the case is one in which it matters
    assert np.all(np.abs(part.direct - limit) < 5.0 * std), np.abs(part.direct - limit) / std
    centre, radius = part.plant.disc(0.05 / part.f.size)
    assert np.all(np.abs(plant - centre) <= radius)
    bias, off = part.find_bias(0.05), np.abs(limit - centre) > radius + 5.0 * std
    assert np.any(off) and bias.lines >= np.count_nonzero(off)
    at = int(np.argmin(np.abs(part.f - bias.where_hz)))
    assert np.isclose(bias.largest, np.abs(limit[at] / plant[at] - 1.0), rtol=0.1)
    record = json.loads(to_json(result.to_dict()))["response"]["measured"][0]
    said = {"lines": bias.lines, "largest": bias.largest, "where_hz": bias.where_hz, "by_noise": True}
    assert record["direct_bias"] == said
    assert np.allclose(np.array(record["plant_re"]) + 1j * np.array(record["plant_im"]), part.plant.value)
    assert np.allclose(np.array(record["direct_re"]) + 1j * np.array(record["direct_im"]), part.direct)
    text = " ".join(repr(result).split())
    assert f"would be off by up to {100.0 * bias.largest:.2g} % (at " in text and "as noise goes round the loop" in text


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_nothing_is_said_of_a_direct_estimate_that_is_not_shown_to_be_off(controller, bench, noise):
    result = so.accept(controller, [bench.log(Machine(), WAVE[: 10 * PERIOD], noise=noise)])
    (part,) = result.response.measured
    assert part.find_bias(0.05) is None and "from command and readings alone" not in " ".join(repr(result).split())


def make_blocks(controller, noise, of_log, sets=1):
    """Return periods of a plant k/(j f/10 + 1) under the law's own equations, with white noise on what is read and on
    the command as it is logged; to what the direct estimate tends, and its std.
    """
    rng, f, periods = np.random.default_rng(5), np.geomspace(4.0, 60.0, 12), 600

    def draw(size):
        return size * (rng.normal(size=(periods, f.size)) + 1j * rng.normal(size=(periods, f.size))) / np.sqrt(2.0)

    forward, back = controller.law.responses(f)
    feedback, plant = -back, (0.9 / abs(back[1])) / (0.1j * f + 1.0)
    realisation = np.repeat(np.arange(sets), periods // sets)
    reference = np.exp(2j * np.pi * rng.uniform(size=(sets, f.size)))[realisation]
    sensitivity, read = 1.0 / (1.0 + plant * feedback), draw(noise)
    output = sensitivity * (plant * forward * reference + read)
    effort = sensitivity * (forward * reference - feedback * read) + of_log * np.abs(sensitivity * forward) * draw(1.0)
    blocks = Blocks(
        f=f, reference=reference, effort=effort, measured=output[:, None, :], beside={}, realisation=realisation,
        rows=1000, period_s=1.0, amplitude=1.0, swing=1.0, noise=0.0, left_out=LeftOut(), between=output[:, :0],
    )  # fmt: skip
    spread = np.abs(sensitivity * feedback * noise) ** 2, np.abs(of_log * sensitivity * forward) ** 2
    power = np.abs(sensitivity * forward) ** 2
    total = power + spread[0] + spread[1]
    limit = (plant * power - spread[0] / feedback) / total
    return blocks, limit, np.abs(limit - plant) / np.sqrt(periods * (spread[0] + spread[1]) / total)


@pytest.mark.parametrize("sets", [1, 6])
@pytest.mark.parametrize(("noise", "of_log", "by_noise"), [(0.4, 0.0, True), (0.0, 0.5, False), (0.1, 0.7, False)])
def test_noise_is_named_only_where_it_makes_the_bias(controller, noise, of_log, by_noise, sets):
    """Noise of the command as it is logged goes round no loop: the direct estimate tends to the plant times the share
    of the command that the reference makes, in place of a mean with -1/C.
    """
    blocks, limit, std = make_blocks(controller, noise, of_log, sets)
    part = measure(controller, blocks, by_phases=False)
    assert np.all(np.abs(part.direct - limit) < 5.0 * std), np.abs(part.direct - limit) / std
    bias = part.find_bias(0.05)
    assert bias is not None and bias.by_noise == by_noise, bias
    assert ("as noise goes round the loop" in say_bias(bias)) == by_noise and "% (at " in say_bias(bias)
