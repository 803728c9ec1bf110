"""The delay that a fit found or was given, as whole samples of a controller, for tuner and certificate.

An experiment's delay runs from a row's command to its effect in the log's measurement: what command path, drive, sensor
and transport add, as far as the log's clock sees it. In a loop that commands and measures over the same path it is the
delay from measurement to output, besides the hold, once the controller answers in the sample in which it measures.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar, Protocol, TypeVar, runtime_checkable

from seaopt.estimation import Fit
from seaopt.formatting import format_count
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


@runtime_checkable
class DelayedSpec(Protocol):
    """What a specification says of time."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def delay_samples(self) -> int | None:
        """Whole samples from measurement to output, besides the hold; None: not given."""
        ...

    @property
    def sample_rate_hz(self) -> float:
        """Of the controller."""
        ...


SpecT = TypeVar("SpecT", bound=DelayedSpec)
NEGLIGIBLE = 0.01  # of a sample: a delay that is beyond whole samples by less is that many


def count_delay_samples(delay_s: float, sample_rate_hz: float) -> int:
    """Return a delay in samples, rounded up to whole ones.

    Examples
    --------
    >>> count_delay_samples(2.04e-3, 1000.0), count_delay_samples(2.0e-3, 1000.0), count_delay_samples(0.0, 1000.0)
    (3, 2, 0)

    """
    return max(0, math.ceil(delay_s * sample_rate_hz - NEGLIGIBLE))


def settle_delay(spec: SpecT, plant: Plant, source: Fit | ParameterSet) -> SpecT:
    """Return a specification with its delay: as given, or that of a fit's experiments rounded up, 1 at least."""
    if spec.delay_samples is not None:
        return spec
    found = count_delay_samples(source.delay_s(plant), spec.sample_rate_hz) if isinstance(source, Fit) else 0
    return replace(spec, delay_samples=max(1, found))


def warn_short_delay(
    delay_samples: int, sample_rate_hz: float, plant: Plant, source: Fit | ParameterSet
) -> tuple[str, ...]:
    """Return a warning where a controller counts on less delay than the fit's experiments have."""
    if not isinstance(source, Fit):
        return ()
    delay_s = source.delay_s(plant)
    needed = count_delay_samples(delay_s, sample_rate_hz)
    if delay_samples >= needed:
        return ()
    counted = format_count(delay_samples, "sample")
    return (
        f"delay_samples = {delay_samples}, but the experiments have a delay of {1e3 * delay_s:.4g} ms, "
        f"{format_count(needed, 'sample')} at {sample_rate_hz:g} Hz: a loop with that delay has smaller margins than "
        f"stated for {counted}; give delay_samples = {needed}, or leave it out",
    )
