"""The certificate: one controller against many plants, nominal and over everything the data cannot rule out."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, LoopFigures
from seaopt.control.tuner import BANDWIDTH_TOLERANCE
from seaopt.errors import ControlError, FileError
from seaopt.estimation import Fit
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.robustness.batch import BatchFigures, batch_figures
from seaopt.robustness.draws import uncertainty

SCHEMA = "seaopt/robustness/1"
CONFIDENCE = 1.0 - 1e-6
ROUNDING = 1e-6
_REPORTED = (
    "stable", "bandwidth_hz", "tracking_band_hz", "ms", "mt", "gain_margin_db", "phase_margin_deg", "delay_margin_s",
    "disk_margin",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """One figure against its limit; `where` names the plant, and the parameters that decide if a draw does."""

    name: str
    limit: float
    value: float
    met: bool
    where: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Worst:
    """The draw that comes nearest to failing, or fails most: its parameters are the witness.

    Draws are ranked by instability, then by how much of the Ms or Mt limit they use; by Ms where there is no limit.
    """

    parameters: dict[str, float]
    ms: float
    mt: float
    severity: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MonteCarlo:
    """Draws and failures; with `confidence`, the probability of failure is below `failure_probability_bound`."""

    samples: int
    failures: int
    seed: int
    failure_probability_bound: float
    confidence: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate:
    """What `certify` returns.

    Parameters
    ----------
    passed : bool
        Every requirement is met.
    requirements : tuple of Requirement
    plants : mapping of name to LoopFigures
        At the nominal parameters.
    worst : mapping of name to Worst
        Of the Monte Carlo draws.
    monte_carlo : MonteCarlo
        Over all plants: a draw fails if it fails on any of them.
    controller : Controller
        What was certified.
    models : mapping of name to Plant
        What it was certified on, at `parameters`.

    """

    passed: bool
    requirements: tuple[Requirement, ...]
    plants: Mapping[str, LoopFigures]
    worst: Mapping[str, Worst]
    monte_carlo: MonteCarlo
    controller: Controller
    models: Mapping[str, Plant]
    parameters: ParameterSet

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        controller: Controller,
        models: Mapping[str, Plant],
        parameters: ParameterSet,
    ) -> Certificate:
        """Return the certificate of a robustness.json; figures at the nominal parameters are computed again.

        Raises
        ------
        FileError
            A field is missing or malformed.

        """
        try:
            worst = {name: Worst(**_infinite(item["worst"])) for name, item in content["plants"].items()}
            return cls(
                passed=bool(content["passed"]),
                requirements=tuple(Requirement(**_infinite(item)) for item in content["requirements"]),
                plants={name: controller.close(models[name], parameters).figures() for name in worst},
                worst=worst,
                monte_carlo=MonteCarlo(**content["monte_carlo"]),
                controller=controller,
                models=models,
                parameters=parameters,
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise FileError(f"robustness.json: {error} is missing or malformed; certify again") from error

    def to_dict(self) -> dict[str, Any]:
        """Return the content of robustness.json (schema seaopt/robustness/1)."""
        return {
            "schema": SCHEMA,
            "passed": self.passed,
            "requirements": [_fields(item) for item in self.requirements],
            "plants": {
                name: {key: getattr(item, key) for key in _REPORTED} | {"worst": _fields(self.worst[name])}
                for name, item in self.plants.items()
            },
            "monte_carlo": _fields(self.monte_carlo),
            "passivity": None,
            "simulation": None,
        }

    def __repr__(self) -> str:
        lines = [f"Certificate: {'passed' if self.passed else 'FAILED'}"]
        for name, item in self.plants.items():
            band = item.tracking_band_hz
            shown = "none" if band is None else f"{band[0]:.3g} to {band[1]:.4g} Hz"
            lines.append(
                f"  {name}: {'stable' if item.stable else 'UNSTABLE'}, Ms {item.ms:.4g}, Mt {item.mt:.4g} (worst draw "
                f"{self.worst[name].ms:.4g}, {self.worst[name].mt:.4g}), tracking band {shown}"
            )
        mc = self.monte_carlo
        lines.append(
            f"  {mc.failures} failures in {mc.samples} draws: failure probability below "
            f"{mc.failure_probability_bound:.2%} at a confidence of {_confidence(mc.confidence)}"
            if mc.samples
            else "  no draws: nothing is uncertain; give a fit, prior_std or ranges for a statement on robustness"
        )
        for item in self.requirements:
            if not item.met:
                lines.append(f"  NOT MET: {item.name} = {item.value:.4g}, limit {item.limit:.4g} ({item.where})")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def _confidence(value: float) -> str:
    rest = 1.0 - value
    return f"1 - {rest:.0e}" if rest < 1e-3 else f"{value:.3%}"


def _infinite(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields with null read as infinite: JSON has no infinity."""
    return {key: np.inf if value is None else value for key, value in item.items()}


def _fields(item: Any) -> dict[str, Any]:
    return {field.name: getattr(item, field.name) for field in fields(item)}


def certify(
    controller: Controller,
    plants: Mapping[str, Plant],
    parameters: Fit | ParameterSet,
    *,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    others: ParameterSet | None = None,
    samples: int = 1375,
    seed: int = 1,
    confidence: float = CONFIDENCE,
) -> Certificate:
    """Check a controller against plants, at the nominal parameters and over draws.

    Everything is computed from the controller's two transfer functions; every plant is closed from the current that
    the controller commands, so that its own eta, K_tau and lead change the loop gain.

    Parameters
    ----------
    controller : Controller
        The law.
    plants : mapping of name to Plant
        What it must survive.
    parameters : Fit or ParameterSet
        A fit's joint distribution, truncated to the bounds; or values, with the prior_std of those that have one.
    ranges : mapping of name to (low, high), optional
        Parameters drawn uniformly instead.
    others : ParameterSet, optional
        Values of parameters that the fit's plants do not have; the plants' defaults where left out.
    samples : int
        Draws; 1375 without a failure bound the failure probability by 1 % at a confidence of 1 - 1e-6.
    seed : int
        Of the draws; use another than in tuning.
    confidence : float
        Of the bound (Clopper-Pearson).

    Returns
    -------
    Certificate
        A draw fails if a plant is unstable there, or breaks the specification's Ms or Mt.

    Raises
    ------
    ControlError
        There is no plant, a plant lacks the measured output, a range is empty, or the fit leaves a parameter open.

    Examples
    --------
    >>> import seaopt as so
    >>> params, swing = so.plants.thor(), so.plants.moving_output()
    >>> spec = so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6)
    >>> controller = so.tune(so.plants.high_impedance(), params, spec, robust_to={"swing": swing})
    >>> certificate = so.certify(controller, {"swing": swing}, params, ranges={"I_p": (0.3, 0.5)}, samples=100)
    >>> certificate.passed, certificate.monte_carlo.failures
    (True, 0)

    """
    if not isinstance(plants, Mapping):
        raise ControlError(f"plants is a {type(plants).__name__}; give a mapping of name to plant")
    if not plants:
        raise ControlError("certify needs at least one plant; give {name: plant}")
    if samples < 1:
        raise ControlError(f"samples = {samples} is not a number of draws; give 1 or more")
    if not 0.0 < confidence < 1.0:
        raise ControlError(f"confidence = {confidence:g} is not between 0 and 1")
    unknown = uncertainty(parameters, others or ParameterSet(), ranges or {}, plants)
    nominal = unknown.nominal
    figures = {name: controller.close(plant, nominal).figures() for name, plant in plants.items()}
    draws = unknown.draw(samples, np.random.default_rng(seed))
    batches = {name: batch_figures(controller, plant, nominal, draws) for name, plant in plants.items()}
    samples = samples if draws else 0  # nothing is uncertain: there is nothing to draw
    failed = np.zeros(max(samples, 1), dtype=bool)
    for batch in batches.values():
        failed |= _failures(controller, batch)
    worst = {name: _worst(controller, plants[name], nominal, draws, batch) for name, batch in batches.items()}
    failures = int(np.count_nonzero(failed)) if draws else 0
    monte_carlo = MonteCarlo(
        samples=samples, failures=failures, seed=seed, confidence=confidence,
        failure_probability_bound=failure_bound(samples, failures, confidence),
    )  # fmt: skip
    requirements = (
        *_design_requirements(controller, _design_figures(controller, nominal)),
        *(item for name in plants for item in _plant_requirements(controller, name, figures[name])),
        *_monte_carlo_requirement(monte_carlo, worst),
    )
    return Certificate(
        passed=all(item.met for item in requirements), requirements=requirements, plants=figures, worst=worst,
        monte_carlo=monte_carlo, controller=controller, models=dict(plants), parameters=nominal,
    )  # fmt: skip


def failure_bound(samples: int, failures: int, confidence: float) -> float:
    """Return the upper Clopper-Pearson bound of a failure probability (Biometrika 26, 1934).

    Examples
    --------
    >>> round(failure_bound(1375, 0, 1 - 1e-6), 4)
    0.01

    """
    if failures >= samples:
        return 1.0
    from scipy.special import betaincinv

    return float(betaincinv(failures + 1, samples - failures, confidence))


def _limits(controller: Controller) -> tuple[float, float]:
    spec = controller.spec
    ms = spec.max_sensitivity if spec.max_sensitivity is not None else np.inf
    mt = spec.max_complementary if spec.max_complementary is not None else np.inf
    return ms * (1 + ROUNDING), mt * (1 + ROUNDING)


def _failures(controller: Controller, batch: BatchFigures) -> np.ndarray[Any, np.dtype[np.bool_]]:
    ms, mt = _limits(controller)
    return (batch.spectral_radius >= 1.0) | (batch.ms > ms) | (batch.mt > mt)


def _worst(
    controller: Controller, plant: Plant, nominal: ParameterSet, draws: Mapping[str, Float[np.ndarray, " n"]],
    batch: BatchFigures,
) -> Worst:  # fmt: skip
    """Return the worst draw, measured again one by one."""
    ms, mt = _limits(controller)
    with np.errstate(invalid="ignore"):  # infinite over infinite, of unstable draws, which are ranked below
        used = np.maximum(batch.ms / ms, batch.mt / mt) if np.isfinite(min(ms, mt)) else batch.ms
    severity = np.where(batch.spectral_radius >= 1.0, 1e6 + batch.spectral_radius, used)
    k = int(np.argmax(severity))
    values = {name: float(drawn[k]) for name, drawn in draws.items() if name in plant.parameters}
    witness = plant.complete(nominal)
    witness = witness.update(**values)
    found = controller.close(plant, witness).figures()
    return Worst(parameters=values, ms=found.ms, mt=found.mt, severity=float(severity[k]))


def _design_figures(controller: Controller, nominal: ParameterSet) -> LoopFigures:
    """Return the figures of the design plant at the nominal parameters, computed from the law again."""
    if controller.design is None:
        raise ControlError(
            "the controller does not know its design plant; tune it, or read it with Controller.from_dict"
        )
    plant, values = controller.design
    named = values.with_parameters(*(nominal[name] for name in nominal if name in plant.parameters))
    return controller.close(plant, named).figures()


def _design_requirements(controller: Controller, achieved: LoopFigures) -> list[Requirement]:
    spec = controller.spec
    reached = achieved.bandwidth_hz if achieved.bandwidth_hz is not None else np.inf
    rows = [
        Requirement(
            name="bandwidth_hz", limit=spec.bandwidth_hz, value=reached, where="design",
            met=bool(abs(reached / spec.bandwidth_hz - 1.0) <= BANDWIDTH_TOLERANCE),
        ),
        Requirement(
            name="min_sensitivity_bandwidth_hz", limit=spec.sensitivity_bandwidth_limit_hz,
            value=achieved.sensitivity_bandwidth_hz, where="design",
            met=achieved.sensitivity_bandwidth_hz >= spec.sensitivity_bandwidth_limit_hz * (1 - 1e-3),
        ),
    ]  # fmt: skip
    peaks = (("max_reference_peak", achieved.reference_peak), ("max_noise_gain", achieved.noise_gain))
    rows += [item for name, value in peaks for item in _upper(name, getattr(spec, name), value, "design")]
    return rows


def _plant_requirements(controller: Controller, name: str, figures: LoopFigures) -> list[Requirement]:
    spec = controller.spec
    return [
        Requirement(name="spectral_radius", limit=1.0, value=figures.spectral_radius, met=figures.stable, where=name),
        *_upper("max_sensitivity", spec.max_sensitivity, figures.ms, name),
        *_upper("max_complementary", spec.max_complementary, figures.mt, name),
    ]


def _upper(name: str, limit: float | None, value: float, where: str) -> list[Requirement]:
    if limit is None:
        return []
    return [Requirement(name=name, limit=limit, value=value, met=bool(value <= limit * (1 + ROUNDING)), where=where)]


def _monte_carlo_requirement(result: MonteCarlo, worst: Mapping[str, Worst]) -> list[Requirement]:
    if not result.samples:
        return []
    name = max(worst, key=lambda key: worst[key].severity)
    where = ", ".join(f"{key} = {value:.4g}" for key, value in worst[name].parameters.items())
    witness = f"{name}: worst draw has Ms {worst[name].ms:.4g}, Mt {worst[name].mt:.4g}" + (
        f" at {where}" if where else ""
    )
    remedy = (
        "" if result.failures == 0 else "; tune with that plant in robust_to, a larger reserve or a lower bandwidth"
    )
    return [
        Requirement(
            name="monte_carlo_failures", limit=0.0, value=float(result.failures), met=result.failures == 0,
            where=witness + remedy,
        )
    ]  # fmt: skip
