"""The bandwidths of a sweep, as the command line takes them."""

from __future__ import annotations

import math

from seaopt.errors import ControlError

MAX_BANDWIDTHS = 200


def parse_bandwidths(text: str) -> tuple[float, ...]:
    """Return the bandwidths of LOW:HIGH:STEP, both ends included; else refuse what no such range is (ControlError)."""
    try:
        low, high, step = (float(number) for number in text.split(":"))
    except ValueError as error:
        raise ControlError(f'--sweep {text}: is not LOW:HIGH:STEP; give three numbers such as "15:60:5"') from error
    if not (0.0 < low <= high < math.inf and 0.0 < step < math.inf):
        raise ControlError(f"--sweep {text}: is not ascending; give 0 < LOW <= HIGH and a positive STEP")
    steps = (high - low) / step * (1 + 1e-12) + 1e-9
    count = math.floor(min(steps, 2.0 * MAX_BANDWIDTHS)) + 1
    if count > MAX_BANDWIDTHS:
        raise ControlError(
            f"--sweep {text}: asks for {steps + 1:.10g} bandwidths; give a larger STEP, for {MAX_BANDWIDTHS} at most"
        )
    return tuple(low + k * step for k in range(count))
