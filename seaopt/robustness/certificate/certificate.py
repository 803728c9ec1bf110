"""The certificate: what one controller does on many plants, as data, JSON and text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields, replace
from typing import Any

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller, LoopFigures
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.errors import FileError, SeaoptError
from seaopt.estimation import resting_on
from seaopt.formatting import format_figure, html_list, html_paragraph, html_table
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.bounds.bracket import Bracket
from seaopt.robustness.certificate.nominal import PlantMargins, plant_margins
from seaopt.robustness.certificate.simulated import Simulated, simulated
from seaopt.robustness.uncertainty.draws import Varied
from seaopt.robustness.uncertainty.worst import Worst, measure_worst
from seaopt.robustness.verification.verification import witness

SCHEMA = "seaopt/robustness/1"
SIMULATION = "simulation_failures"
FEW = 0.1  # failure probability above which no failure in the draws is noted to say little
DESIGN_NAMES = ("design", "design plant")  # of the design plant where the caller does not list it
_REPORTED = (
    "stable", "bandwidth_hz", "tracking_band_hz", "ms", "mt", "gain_margin_db", "phase_margin_deg", "delay_margin_s",
    "disk_margin", "noise_gain", "spectral_radius",
)  # fmt: skip


@record
class Requirement:
    """One figure against its limit; `where` names the plant, and the parameters that decide if a draw does."""

    name: str
    limit: float
    value: float
    met: bool
    where: str

    @property
    def sense(self) -> str:
        """What the value must be to the limit, as a sign; of draws and worst cases it is at most that."""
        return BY_REQUIREMENT[self.name].symbol if self.name in BY_REQUIREMENT else "≤"


@record
class MonteCarlo:
    """Draws and failures; with `confidence`, the probability of failure is below `failure_probability_bound`.

    Of the failures, `unstable` draws are so on some plant; of the others, `over_ms` break Ms, and `over_mt` Mt alone.
    """

    samples: int
    failures: int
    seed: int
    failure_probability_bound: float
    confidence: float
    unstable: int = 0
    over_ms: int = 0
    over_mt: int = 0

    def __str__(self) -> str:
        if not self.samples:
            return "no draws: nothing is uncertain; give a fit, prior_std or ranges for a statement on robustness"
        counts = ((self.unstable, "unstable"), (self.over_ms, "over Ms"), (self.over_mt, "over Mt"))
        kinds = ", ".join(f"{count} {kind}" for count, kind in counts if count)
        head = f"{self.failures} failures in {self.samples} draws" + (f" ({kinds})" if kinds else "")
        if self.failures == self.samples:
            return head
        return (
            f"{head}: failure probability below {self.failure_probability_bound:.3g} at a confidence of "
            f"{_confidence(self.confidence)}"
        )

    def _repr_html_(self) -> str:
        return draws_html(self)


@record(eq=False)
class Certificate:
    """What `certify` returns.

    Parameters
    ----------
    passed : bool
        Every requirement is met.
    requirements : tuple of Requirement
    plants : mapping of name to LoopFigures
        At the nominal parameters.
    margins : mapping of name to PlantMargins
        Every margin at the nominal parameters, with the perturbation that uses it up.
    worst : mapping of name to Worst
        The worst that the draws, and a search from the worst of them, found: each is a pair (plant, parameters), so
        that `tune(..., robust_to=certificate.worst)` takes them back.
    monte_carlo : MonteCarlo
        Over all plants: a draw fails if it fails on any of them.
    varied : tuple of Varied
        What the draws and the worst cases vary, and how.
    controller : Controller
        What was certified.
    models : mapping of name to Plant
        What it was certified on, at `parameters`.
    simulated : Simulated or None
        What `with_simulation` found.
    brackets : mapping of name to Bracket
        What the worst case is proven to be below; empty if bounds were not asked for.

    """

    passed: bool
    requirements: tuple[Requirement, ...]
    plants: Mapping[str, LoopFigures]
    margins: Mapping[str, PlantMargins]
    worst: Mapping[str, Worst]
    monte_carlo: MonteCarlo
    controller: Controller
    models: Mapping[str, Plant]
    parameters: ParameterSet
    varied: tuple[Varied, ...] = ()
    simulated: Simulated | None = None
    brackets: Mapping[str, Bracket] = field(default_factory=dict[str, Bracket])

    def with_simulation(
        self, *, sensors: Sensors | None = None, current_step_A: float = 0.0, seed: int = 1
    ) -> Certificate:
        """Return the certificate with its controller simulated on the nonlinear plants, at their worst draws too.

        Each scenario that fails is a requirement that is not met. Large signals, on every plant, passivity and coupled
        stability, on the design plant, require nothing.

        Parameters
        ----------
        sensors : Sensors, optional
            Of the measured output; ideal if left out.
        current_step_A : float
            What the current is rounded to; 0 for not at all.
        seed : int
            Of noise and random excitations.

        Examples
        --------
        >>> import seaopt as so
        >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
        >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0))
        >>> certificate = so.certify(controller, {"stand": stand}, thor).with_simulation()
        >>> certificate.passed, len(certificate.simulated.verification.rows)
        (True, 8)

        """
        found = self._simulated(sensors, current_step_A, seed)
        kept = tuple(item for item in self.requirements if item.name != SIMULATION)
        requirements = (*kept, *_simulation_requirements(found))
        return replace(self, simulated=found, requirements=requirements, passed=all(item.met for item in requirements))

    def _simulated(self, sensors: Sensors | None, current_step_A: float, seed: int) -> Simulated:
        draws = {name: [worst[1]] for name, worst in self.worst.items()}
        return simulated(
            self.controller, self.models, self.parameters, draws=draws, sensors=sensors,
            current_step_A=current_step_A, seed=seed,
        )  # fmt: skip

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        controller: Controller,
        models: Mapping[str, Plant],
        parameters: ParameterSet,
    ) -> Certificate:
        """Return the certificate of a robustness.json; nominal figures and simulations are computed again.

        Raises
        ------
        FileError
            A field is missing or malformed.

        """
        if controller.design is not None:  # certified too where nobody listed it
            models = dict.fromkeys(DESIGN_NAMES, controller.design[0]) | dict(models)
        try:
            models = {name: models[name] for name in content["plants"]}
            worst = {
                name: measure_worst(controller, models[name], parameters, item["worst"]["parameters"])
                for name, item in content["plants"].items()
            }
            requirements = tuple(Requirement(**_infinite(item)) for item in content["requirements"])
            found = cls(
                passed=all(item.met for item in requirements),
                requirements=requirements,
                plants={name: controller.close(models[name], parameters).figures() for name in worst},
                margins={name: plant_margins(controller, models[name], parameters) for name in worst},
                worst=worst,
                monte_carlo=MonteCarlo(**content["monte_carlo"]),
                controller=controller,
                models=models,
                parameters=parameters,
                varied=tuple(_varied(item) for item in content.get("varied", [])),
                brackets={
                    name: Bracket.from_dict(item["worst"])
                    for name, item in content["plants"].items()
                    if "ms_upper" in item["worst"]
                },
            )
            played = content.get("simulation")
            if played is None:
                return found
            sensors = Sensors(**played["sensors"])
            return replace(found, simulated=found._simulated(sensors, played["current_step_A"], played["seed"]))
        except (KeyError, TypeError, ValueError, AttributeError, SeaoptError) as error:
            raise FileError(f"robustness.json: {error} is missing or malformed; certify again") from error

    def to_dict(self) -> dict[str, Any]:
        """Return the content of robustness.json (schema seaopt/robustness/1)."""
        return {
            "schema": SCHEMA,
            "passed": self.passed,
            "requirements": [_fields(item) for item in self.requirements],
            "plants": {
                name: {key: getattr(item, key) for key in _REPORTED}
                | self.margins[name].to_dict()
                | {"worst": _fields(self.worst[name].witness) | self._bounds(name)}
                for name, item in self.plants.items()
            },
            "monte_carlo": _fields(self.monte_carlo),
            "varied": [_fields(item) for item in self.varied],
            "notes": list(self.notes),
            "passivity": None if self.simulated is None else self.simulated.passivity_dict(),
            "simulation": None if self.simulated is None else self.simulated.simulation_dict(),
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader should know besides the requirements, one sentence each."""
        used = {name for plant in self.models.values() for name in plant.parameters}
        outside = (
            f"the nominal {item.name} = {item.value:.4g} lies outside its range of {item.low:.4g} to {item.high:.4g}, "
            "so that no draw is like the nominal plant"
            for item in self.varied
            if item.outside
        )
        few = self.monte_carlo.samples and not self.monte_carlo.failures
        bound = self.monte_carlo.failure_probability_bound
        little = (f"so few draws say little: a failure probability below {bound:.2g}",) if few and bound > FEW else ()
        return (*resting_on(self.parameters, used), *outside, *little)

    def _bounds(self, name: str) -> dict[str, Any]:
        return self.brackets[name].to_dict() if name in self.brackets else {}

    def __repr__(self) -> str:
        lines = [f"Certificate: {'passed' if self.passed else 'FAILED'}", *(f"  note: {note}" for note in self.notes)]
        for name in self.plants:
            lines += self._plant_lines(name)
        if self.varied:
            lines.append(f"  varied: {'; '.join(map(str, self.varied))}")
        lines.append(f"  {self.monte_carlo}")
        lines += [f"  {line}" for line in (self.simulated.lines() if self.simulated is not None else [])]
        for item in self.requirements:
            if not item.met:
                lines.append(f"  NOT MET: {item.name} = {item.value:.6g}, limit {item.limit:.6g} ({item.where})")
        return "\n".join(lines)

    def _plant_lines(self, name: str) -> list[str]:
        item, found, worst = self.plants[name], self.margins[name], self.worst[name]
        band = item.tracking_band_hz
        shown = "none" if band is None else f"{band[0]:.3g} to {band[1]:.4g} Hz"
        lines = [
            f"  {name}: {'stable' if item.stable else 'UNSTABLE'}, Ms {item.ms:.4g}, Mt {item.mt:.4g} "
            f"(worst case {worst.ms:.4g}, {worst.mt:.4g}), tracking band {shown}"
        ]
        if item.stable:
            up, down = found.margins.gain_up_db, found.margins.gain_down_db
            late = found.sampled_delay_s
            lines.append(
                f"    gain {_signed(down)} / {_signed(up)} dB, phase {_number(item.phase_margin_deg)} deg, delay "
                + (f"{1e3 * late:.4g} ms" if late is not None else f"beyond {1e3 * found.searched_delay_s:.3g} ms")
                + f", disk margin {item.disk_margin:.3g}"
            )
        if worst.parameters:
            where = ", ".join(f"{key} = {value:.4g}" for key, value in worst.parameters.items())
            lines.append(f"    worst case at {where}")
        if name in self.brackets:
            lines.append(f"    {self.brackets[name].statement}")
        return lines

    def _repr_html_(self) -> str:
        return certificate_html(self)


def _simulation_requirements(found: Simulated) -> list[Requirement]:
    """Return what the scenarios require: one row a plant where all pass, else one a run that failed, its witness."""
    played = found.verification
    if played is None:
        reason = found.left_out["simulation"]
        return [Requirement(name=SIMULATION, limit=0.0, value=np.inf, met=False, where=reason)]
    rows: list[Requirement] = []
    for plant in played.stages:
        runs = [row for row in played.rows if row.plant == plant]
        failed = [row for row in runs if not row.passed]
        rows += [
            Requirement(
                name=SIMULATION, limit=0.0, value=1.0, met=False,
                where=f"{plant}, {row.scenario}, draw {row.draw}, seed {played.seed}: {row.reason}{witness(row)}",
            )
            for row in failed
        ]  # fmt: skip
        if runs and not failed:
            where = f"{plant}: {len(runs)} runs"
            rows.append(Requirement(name=SIMULATION, limit=0.0, value=0.0, met=True, where=where))
    return rows


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"


def _signed(value: float | None) -> str:
    return "none" if value is None else f"{value:+.4g}"


def _confidence(value: float) -> str:
    rest = 1.0 - value
    return f"1 - {rest:.0e}" if rest < 1e-3 else f"{value:.3%}"


def _varied(item: Mapping[str, Any]) -> Varied:
    """Return what is varied; JSON has no infinity, so that a missing bound is one."""
    ends = {
        "low": -np.inf if item["low"] is None else item["low"],
        "high": np.inf if item["high"] is None else item["high"],
    }
    given: dict[str, Any] = {**item, **ends}
    return Varied(**given)


def _infinite(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields with null read as infinite: JSON has no infinity."""
    return {key: np.inf if value is None else value for key, value in item.items()}


def _fields(item: Any) -> dict[str, Any]:
    return {field.name: getattr(item, field.name) for field in fields(item)}


_PLANT_HEAD = (
    "plant", "stable", "Ms", "Mt", "worst Ms", "worst Mt", "gain margin", "phase margin", "delay margin",
    "disk margin", "tracking band", "worst case at",
)  # fmt: skip


def certificate_html(found: Certificate) -> str:
    """Return the plants, the draws, every requirement with what decides it, and what was simulated."""
    verdict = html_paragraph(f"Certificate: {'passed' if found.passed else 'FAILED'}")
    plants = html_table(_PLANT_HEAD, [_plant_row(found, name) for name in found.plants])
    required = html_table(
        ("requirement", "where", "value", "limit", "met"),
        [
            (
                item.name,
                item.where,
                format_figure(item.value),
                f"{item.sense} {format_figure(item.limit)}",
                "yes" if item.met else "NO",
            )
            for item in sorted(found.requirements, key=lambda item: item.met)
        ],
    )
    varied = html_paragraph(f"varied: {'; '.join(map(str, found.varied))}") if found.varied else ""
    simulated = html_list(found.simulated.lines()) if found.simulated is not None else ""
    return verdict + html_list(found.notes) + plants + varied + draws_html(found.monte_carlo) + required + simulated


def draws_html(found: MonteCarlo) -> str:
    """Return the numbers of draws and failures, and the bound."""
    shown = [(field.name.replace("_", " "), getattr(found, field.name)) for field in fields(found)]
    return html_table(
        ("draws", ""), [(name, f"{value:.7g}") for name, value in shown if isinstance(value, (int, float))]
    )


def _plant_row(found: Certificate, name: str) -> tuple[str, ...]:
    item, worst, margins = found.plants[name], found.worst[name], found.margins[name]
    band, late = item.tracking_band_hz, margins.sampled_delay_s
    return (
        name, "yes" if item.stable else "NO", *map(format_figure, (item.ms, item.mt, worst.ms, worst.mt)),
        format_figure(item.gain_margin_db, "dB"), format_figure(item.phase_margin_deg, "deg"),
        format_figure(None if late is None else 1e3 * late, "ms"), format_figure(item.disk_margin),
        "–" if band is None else f"{band[0]:.3g} to {band[1]:.4g} Hz", _where(worst.parameters),
    )  # fmt: skip


def _where(parameters: Mapping[str, float]) -> str:
    return ", ".join(f"{name} = {value:.4g}" for name, value in parameters.items()) or "–"
