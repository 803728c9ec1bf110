"""The certificate of the impedance that a controller renders at the link of one of its plants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.codec import OrMinusInfinite, to_content
from seaopt.control import Controller, Impedance, ImpedanceRegion, Rendering, passive_region, render
from seaopt.control.impedance.link import find_link
from seaopt.control.impedance.moving_loop import close_link
from seaopt.control.impedance.sampled_port import SampledPort
from seaopt.control.loops.loop import GROWING
from seaopt.errors import ControlError, suggestion
from seaopt.executors import Shared
from seaopt.formatting import format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import split_friction
from seaopt.progress import Progress
from seaopt.records import record
from seaopt.robustness.certificate.cases import Cases, Check, CheckContext, Draw, Evidence
from seaopt.robustness.certificate.measured_draws import judge_draws
from seaopt.robustness.certificate.requirement import DrawnAt, Requirement, require_at_most
from seaopt.robustness.uncertainty.worst import place_values
from seaopt.robustness.verification.impedance_steps import AT_REST, ImpedanceStep, play_impedance_steps

IMPEDANCE_DRAWS = 100  # at most so many are looked at
SECONDS = 0.05  # that a draw takes as a rule


@record
class ImpedanceDraws:
    """For how many draws the link is stable, and passive with its own damper, friction sliding and stuck."""

    samples: int
    stable: int
    passive: int
    margin: OrMinusInfinite  # the least of the passivity condition, as a share: above zero it is kept
    parameters: dict[str, float]  # of the draw with the least margin

    def __str__(self) -> str:
        at = f", least so at {format_values(self.parameters)}" if self.parameters else ""
        return f"over draws, stable in {self.stable} of {self.samples} and passive in {self.passive}{at}"


@record(eq=False)
class CertifiedImpedance:
    """An impedance at a link, as it is rendered, and what could be."""

    plant: str  # whose link it is
    rendering: Rendering  # the pair that is asked for, with friction sliding
    region: ImpedanceRegion  # every pair with the same filter
    stuck: Rendering | None = None  # the same pair with friction stuck, of a plant that has some
    draws: ImpedanceDraws | None = None  # None where nothing is uncertain, or it fails without draws
    steps: tuple[ImpedanceStep, ...] = ()  # of x_0, simulated on the nonlinear plant

    @property
    def safe(self) -> bool:
        """The link rests by itself and is passive, with friction sliding and stuck, at the nominal parameters."""
        return all(pair.stable and pair.passive for pair in (self.rendering, self.stuck) if pair is not None)

    def to_dict(self) -> dict[str, Any]:
        """Return all of it, for robustness.json."""
        return (
            {"plant": self.plant}
            | self.rendering.to_dict()
            | {
                "region": self.region.to_dict(),
                "stuck": None if self.stuck is None else self.stuck.to_dict(),
                "draws": to_content(self.draws),
                "steps": to_content(self.steps),
            }
        )

    def lines(self) -> list[str]:
        """Return the findings, one line each."""
        pair, called = self.rendering.impedance, self.rendering.called
        head = f"{pair.stiffness:.4g} {called.stiffness} and {pair.damping:.4g} {called.damping} at the link of "
        stuck = [] if self.stuck is None else [f"with its friction stuck: {self.stuck.describe()[0]}"]
        drawn = [] if self.draws is None else [str(self.draws)]
        return [
            f"{head}{self.plant}: {'; '.join(self.rendering.describe())}",
            *stuck,
            *drawn,
            *(step.describe(self.rendering.outer.place_unit) for step in self.steps),
            *self.region.describe(),
        ]


def measure_impedance(context: CheckContext, progress: Progress) -> Evidence:
    """Return what the outer loop renders, over draws too where it is safe at the nominal parameters."""
    cases = context.cases
    impedance = certify_impedance(cases.controller, cases.models, cases.unknown.nominal)
    if impedance is not None and impedance.safe:
        impedance = replace(impedance, draws=draw_impedance(context, progress))
    scope = "drawn" if impedance is not None and impedance.draws is not None else "nominal"
    return Evidence(requirements=impedance_requirements(impedance), fields={"impedance": impedance}, scope=scope)


IMPEDANCE = Check(
    measure=measure_impedance,
    seconds=lambda context: SECONDS * min(context.samples, IMPEDANCE_DRAWS),
    applies=lambda context: context.cases.controller.outer is not None,
)


def certify_impedance(
    controller: Controller,
    models: Mapping[str, Plant],
    parameters: ParameterSet,
    draws: ImpedanceDraws | None = None,
    steps: tuple[ImpedanceStep, ...] | None = None,
) -> CertifiedImpedance | None:
    """Measure the impedance of a controller's outer loop at the nominal parameters; None where it has none. `draws` is
    what `draw_impedance` found; `steps` what was simulated, which is simulated if left out.
    """
    outer = controller.outer
    if outer is None:
        return None
    name = _find_plant(controller, models)
    impedance, model = outer.impedance, models[name]
    sliding, *stuck = split_friction({name: model}, parameters).values()
    return CertifiedImpedance(
        plant=name,
        rendering=render(controller, sliding, parameters, impedance),
        region=passive_region(controller, sliding, parameters, velocity_filter_s=impedance.velocity_filter_s),
        stuck=render(controller, stuck[0], parameters, impedance) if stuck else None,
        draws=draws,
        steps=play_impedance_steps(controller, model, parameters) if steps is None else steps,
    )


def _find_plant(controller: Controller, models: Mapping[str, Plant]) -> str:
    """Return the name of the model at whose link the controller's outer loop renders its impedance."""
    assert controller.outer is not None
    moving = [name for name, plant in models.items() if plant.port is not None and plant.port.motion is not None]
    name = controller.outer.plant or next(iter(moving), "")
    if not controller.outer.position:
        raise ControlError("impedance: its position, the output that it reads, is not given; tune again")
    if name not in moving:
        raise ControlError(
            f'the impedance is rendered at the link of plant "{name}", which is not one of the certified plants whose '
            f"link moves; {suggestion(name, moving)}"
        )
    return name


def draw_impedance(context: CheckContext, progress: Progress) -> ImpedanceDraws | None:
    """Judge the impedance of a controller's outer loop at draws; None where nothing is drawn."""
    name = _find_plant(context.cases.controller, context.cases.models)
    progress("impedance, draws", 0.0)
    pairs = judge_draws(context, IMPEDANCE_DRAWS, {name: _judge_states}).get(name)
    if pairs is None:
        return None
    draw, (_, margin) = min(pairs, key=lambda pair: pair[1][1])
    parameters = context.cases.models[name].parameters
    return ImpedanceDraws(
        samples=len(pairs),
        stable=sum(rests for _, (rests, _) in pairs),
        passive=sum(margin > 0.0 for _, (_, margin) in pairs),
        margin=margin,
        parameters={key: value for key, value in draw.items() if key in parameters},
    )


def _judge_states(cases: Shared[Cases], name: str, draws: Sequence[Draw]) -> list[tuple[bool, float]]:
    """Return whether the link rests by itself, sliding and stuck, and the least margin, at every draw."""
    controller, unknown = cases.value.controller, cases.value.unknown
    assert controller.outer is not None
    varied = [row.name for row in unknown.varied()]
    states = split_friction({name: cases.value.models[name]}, unknown.nominal, varied).values()
    judged: list[tuple[bool, float]] = []
    for draw in draws:
        placed = ((state, place_values(state, unknown.nominal, draw)) for state in states)
        rests, margins = zip(*(_judge(controller, *pair, controller.outer.impedance) for pair in placed), strict=True)
        judged.append((all(rests), min(margins)))
    return judged


def _judge(controller: Controller, plant: Plant, params: ParameterSet, impedance: Impedance) -> tuple[bool, float]:
    """Return whether the link rests by itself, and the margin of the passivity condition with its own damper."""
    link = find_link(controller, plant, params)
    outer = link.outer(impedance)
    port = SampledPort(link=link, velocity_filter_s=outer.velocity_filter_s)
    margin, _ = port.worst(impedance, link.load.damping, port.angles())
    radius = close_link(link, outer.velocity_filter_s).radius(impedance.stiffness, impedance.damping)
    return float(radius) <= GROWING, float(margin) if port.held_stable() else -np.inf


def impedance_requirements(impedance: CertifiedImpedance | None) -> list[Requirement]:
    """Return what is required of an impedance, friction sliding and stuck: a stable link in any environment."""
    if impedance is None:
        return []
    called, unit, plant = impedance.rendering.called, impedance.rendering.outer.place_unit, impedance.plant
    rows: list[Requirement] = []
    for state, rendered in (("", impedance.rendering), ("stuck", impedance.stuck)):
        if rendered is None:
            continue
        breaking = "" if rendered.breaking is None else f"; {rendered.breaking.describe(called)}"
        rows += [
            Requirement(
                name="impedance_stable",
                limit=1.0,
                value=rendered.spectral_radius,
                met=rendered.stable,
                plant=plant,
                state=state,
                text="the link with nothing on it",
            ),
            Requirement(
                name="impedance_damper",
                limit=rendered.link_damping,
                value=rendered.needed_damper,
                met=rendered.passive,
                unit=called.damping,
                plant=plant,
                state=state,
                text=f"{called.damping} at the link that make it passive, and its own{breaking}",
            ),
        ]
    drawn = impedance.draws
    if drawn is not None:
        rows.append(
            require_at_most(
                "impedance_draws",
                float(drawn.samples - min(drawn.stable, drawn.passive)),
                0.0,
                plant=plant,
                draw=DrawnAt(parameters=drawn.parameters),
                text=f"stable in {drawn.stable} of {drawn.samples} draws and passive in {drawn.passive}",
            )
        )
    return rows + [
        require_at_most(
            "impedance_rest",
            step.moving,
            AT_REST,
            plant=plant,
            scenario=f"step of x_0 by {step.size:.3g} {unit}",
            text=step.describe(unit),
        )
        for step in impedance.steps
    ]
