"""What a certificate needs of its robustness.json, as pydantic models; all other figures are computed again.

Null stands for what is infinite: the value of a requirement that an unstable plant breaks, a bound that there is not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import Field

from seaopt.bench import Sensors
from seaopt.documents import Flag, NullIsInfinite, NullIsMinusInfinite, Number, ResultTable, Whole, check_table
from seaopt.errors import FileError
from seaopt.files import check_seal, plain
from seaopt.robustness.certificate.certificate import Requirement, find_sense
from seaopt.robustness.certificate.constrained import ConstrainedRuns
from seaopt.units import LINEAR

CERTIFY_AGAIN = "certify again"
OLDER_TOLERANCE = 0.5  # of a bandwidth, of which older files do not say whether a law was tuned for it


class StoredRequirement(ResultTable):
    """A figure against its limit."""

    name: str
    limit: NullIsInfinite
    value: NullIsInfinite
    met: Flag
    where: str
    sense: Literal["≤", "≥", "="] | None = None
    tolerance: Annotated[Number, Field(ge=0.0, le=0.5)] | None = None

    def build(self) -> Requirement:
        """Return the row; of an older file, which does not say it, one that is to be equal may be off by a half."""
        row = Requirement(**self.model_dump(exclude_none=True))
        return replace(row, tolerance=OLDER_TOLERANCE) if self.tolerance is None and row.sense == "=" else row


class StoredLargest(ResultTable):
    """The parameters at which a figure is largest."""

    parameters: dict[str, Number]


class StoredWorst(ResultTable):
    """The parameters of a worst case and of the largest Ms and Mt and, where bounds were asked for, what they prove."""

    parameters: dict[str, Number]
    largest: dict[str, StoredLargest] = {}
    ms_lower: NullIsInfinite = math.inf
    ms_upper: NullIsInfinite = math.inf
    mt_lower: NullIsInfinite = math.inf
    mt_upper: NullIsInfinite = math.inf
    bounded_stable: Flag = False
    boxes: Whole = 0
    left_out: str = ""

    @property
    def cases(self) -> list[dict[str, float]]:
        """The parameters of the worst case, and those of the largest Ms and Mt."""
        return [self.parameters, *(each.parameters for each in self.largest.values())]

    @property
    def bounds(self) -> dict[str, Any] | None:
        """The fields of its `Bracket`; None if bounds were not asked for."""
        return self.model_dump(exclude={"parameters", "largest"}) if "ms_upper" in self.model_fields_set else None


class StoredPlant(ResultTable):
    """A plant: its worst case."""

    worst: StoredWorst


class StoredMonteCarlo(ResultTable):
    """Draws and failures."""

    samples: Whole
    failures: Whole
    seed: Whole
    failure_probability_bound: Number
    confidence: Number
    unstable: Whole = 0
    over_ms: Whole = 0
    over_mt: Whole = 0


class StoredVaried(ResultTable):
    """A quantity that was drawn."""

    name: str
    unit: str
    value: Number | None
    std: Number | None
    low: NullIsMinusInfinite
    high: NullIsInfinite


class StoredSensors(ResultTable):
    """What the simulations read the measured output with."""

    noise_std: dict[str, Number] = {}
    offset: dict[str, Number] = {}
    quantisation: dict[str, Number] = {}
    saturation: dict[str, Number] = {}


class StoredSimulation(ResultTable):
    """What the scenarios were played with."""

    sensors: StoredSensors
    current_step_A: Number
    seed: Whole


class StoredFrictionDraws(ResultTable):
    """For how many draws stability is shown with friction, and the least margin."""

    samples: Whole
    shown: Whole
    least_slope: NullIsInfinite
    factor: NullIsInfinite
    parameters: dict[str, Number]


class StoredFriction(ResultTable):
    """The margin of a plant with friction, of which all but the draws is found again."""

    draws: StoredFrictionDraws | None = None


class StoredImpedanceDraws(ResultTable):
    """For how many draws an impedance is stable and passive, and where it is least so."""

    samples: Whole
    stable: Whole
    passive: Whole
    margin: NullIsMinusInfinite
    parameters: dict[str, Number]


class StoredImpedance(ResultTable):
    """What is rendered at the link, of which all but the draws is found again."""

    draws: StoredImpedanceDraws | None = None


class StoredCompensationDraws(ResultTable):
    """For how many draws stability is shown with friction compensated, and the least slope for which it is."""

    samples: Whole
    shown: Whole
    least_slope: NullIsInfinite
    parameters: dict[str, Number]


class StoredCompensation(ResultTable):
    """The margin of a plant whose friction is compensated from the speed, of which all but the draws is found again."""

    draws: StoredCompensationDraws | None = None


class StoredConstrained(ResultTable):
    """Runs of predictive control with its limits active, the fields of `ConstrainedRuns`."""

    runs: Whole
    failures: Whole
    seed: Whole
    diverged: Whole
    over_bound: Whole
    not_settled: Whole
    confidence: Number
    failure_probability_bound: Number
    bound_tolerance: Number
    largest_violation: Number
    at_limit: Number
    fallback: Number
    iterations: Whole
    ringing: Whole = 0
    largest_ring: Number = 0.0
    sensors: StoredSensors = StoredSensors()
    current_step_A: Number = 0.0
    unit: str = LINEAR.unit
    where: str
    remedy: str = ""
    left_out: tuple[str, ...]


class StoredCertificate(ResultTable):
    """A robustness.json."""

    requirements: list[StoredRequirement]
    plants: dict[str, StoredPlant]
    monte_carlo: StoredMonteCarlo
    varied: list[StoredVaried] = []
    simulation: StoredSimulation | None = None
    remarks: list[str] = []
    friction: dict[str, StoredFriction] = {}
    impedance: StoredImpedance | None = None
    compensation: dict[str, StoredCompensation] = {}
    constrained: StoredConstrained | None = None

    def read_constrained(self) -> ConstrainedRuns | None:
        """Return the runs with limits active, of a certificate of predictive control."""
        if self.constrained is None:
            return None
        sensors = Sensors(**self.constrained.sensors.model_dump())
        return ConstrainedRuns(**self.constrained.model_dump(exclude={"sensors"}), sensors=sensors)


class StoredRequirements(ResultTable):
    """The rows of a robustness.json, or of a schedule_robustness.json."""

    requirements: list[StoredRequirement]


def read_certificate(content: Mapping[str, Any]) -> StoredCertificate:
    """Return what a certificate needs of a robustness.json.

    Raises
    ------
    FileError
        A field is missing or malformed, or it was edited or written by hand.

    """
    check_seal(content, "robustness.json", CERTIFY_AGAIN)
    return check_table(StoredCertificate, plain(content), "robustness.json", remedy=CERTIFY_AGAIN)


def list_requirements(content: Mapping[str, Any], source: str) -> tuple[Requirement, ...]:
    """Return the rows of a certificate as it was read from a file, judged again as `read_requirements` does."""
    stored = check_table(StoredRequirements, plain(content), source, remedy=CERTIFY_AGAIN)
    return read_requirements(stored.requirements, source)


def read_requirements(stored: Sequence[StoredRequirement], source: str = "robustness.json") -> tuple[Requirement, ...]:
    """Return the rows of a certificate.

    Raises
    ------
    FileError
        There are none, which would pass whatever it is of; or a row is called met and its value breaks its limit.

    """
    if not stored:
        raise FileError(f"{source}: requirements is empty, and a certificate requires something; {CERTIFY_AGAIN}")
    rows = tuple(row.build() for row in stored)
    for row in rows:
        known = find_sense(row.name)
        if row.sense not in (known, "≥" if known == "=" else known):  # a law that is given may have more
            raise FileError(
                f"{source}: requirements: {row.name} has the sense {row.sense}, and must be {known} its limit; "
                f"{CERTIFY_AGAIN}"
            )
        if row.met and not row.keeps:
            raise FileError(
                f"{source}: requirements: {row.name} is called met, and its value {row.value:g} is not {row.sense} "
                f"{row.limit:g}; {CERTIFY_AGAIN}"
            )
    return rows
