"""Judge measured loops by the limits of a specification, for the tuner and for the certificate alike."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from seaopt.control.laws.delay import LoopSpec
from seaopt.control.laws.limits import BY_NAME, FAST_BANDWIDTH, LIFTABLE, OTHER_NOISE, Limit, MeasuredLoop, Scope, Sense
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.errors import ControlError
from seaopt.formatting import format_count, join_words
from seaopt.records import record

BLOCKED_CHARACTERS = 145  # of the limits that a message names, so that it stays below three lines of 80
EASED: dict[str, Sense] = {"raise": "at most", "lower": "at least"}
NEARLY_USED = 0.01  # a limit met with no more than this share to spare, and the reserve, is called active


@record
class BindingLimit:
    """A limit that binds or is broken; `plant`: on which, "" where it is the design plant's alone. A file has both in
    one text, as it prints.
    """

    name: str
    plant: str = ""

    def __str__(self) -> str:
        return self.name + _format_plants([self.plant] if self.plant else [])

    @classmethod
    def _from_json(cls, content: str) -> BindingLimit:
        name, _, plant = content.removesuffix(")").partition(" (")
        return cls(name=name, plant=plant)


@record(eq=False)
class LimitVerdict:
    """One limit against one loop's figure; `plant` is the loop's name, `stuck` the design plant stuck by friction."""

    limit: Limit
    plant: str
    value: float
    allowed: float
    met: bool
    stuck: bool = False

    @property
    def names_plant(self) -> bool:
        """Whether the limit holds for several plants, so that it takes a plant's name to say which."""
        return self.limit.scope == "every plant" or self.stuck

    @property
    def binding(self) -> BindingLimit:
        """The limit, with the plant where it holds for several."""
        return BindingLimit(name=self.limit.name, plant=self.plant if self.names_plant else "")

    @property
    def severity(self) -> float:
        """How much of the limit is used; without bound where the loop is unstable or there is no figure."""
        if self.limit.name == "stability" or not np.isfinite(self.value):
            return np.inf
        used = self.limit.usage(self.value, self.allowed)
        return max(used, 1.0 / used) if self.limit.sense == "equal to" else used


@record
class PossibleBandwidths:
    """The bandwidths at which the tuner keeps all limits, from a quarter to twice the one asked."""

    nearest_hz: tuple[float, ...] = ()  # next to the one asked, below and above it; empty if none was found
    largest_hz: float | None = None
    # closest_hz, missed_by: where the limits are missed least, and by which share; zero where they are kept, None where
    # no law was stable
    closest_hz: float | None = None
    missed_by: float | None = None
    # fall, largest_fall: by how much friction falls with speed, where that makes the sliding plant grow without
    # control, and with how much the limits are kept at the bandwidth asked; None where that is not what blocks
    fall: float | None = None
    largest_fall: float | None = None
    fall_unit: str = ""  # of the two
    fall_parameters: tuple[str, ...] = ()  # that the fall depends on

    def __post_init__(self) -> None:
        for pair in (("closest_hz", "missed_by"), ("fall", "largest_fall")):
            if len({getattr(self, name) is None for name in pair}) > 1:
                raise ControlError(f"has one of {' and '.join(pair)}; give both, or neither")

    def __str__(self) -> str:
        bandwidths = self._format_bandwidths()
        if self.fall is None:
            return bandwidths
        values = f"check {join_words(self.fall_parameters)}, " if self.fall_parameters else ""
        return (
            f"{bandwidths}; friction that falls by {self.fall:.4g} {self.fall_unit} makes sliding "
            f"unstable, {self.largest_fall:.4g} can be had here: {values}sample faster or cut the delay"
        )

    def _format_bandwidths(self) -> str:
        if self.largest_hz is None and self.closest_hz is None:
            return "no stable law was found at other bandwidths"
        if self.largest_hz is None:
            missed = f"at {self.closest_hz:.4g} Hz, where the least is missing, one is exceeded by {self.missed_by:.1%}"
            return f"no bandwidth that meets all limits was found; {missed}"
        nearest = " and ".join(f"{f:.4g} Hz" for f in self.nearest_hz)
        most = "" if self.largest_hz in self.nearest_hz else f", {self.largest_hz:.4g} Hz at most"
        verb = "is" if len(self.nearest_hz) == 1 else "are"
        return f"with these limits {nearest} {verb} possible{most} (tuned, not certified)"


def judge(spec: LoopSpec, loop: MeasuredLoop, scope: Scope, *, stuck: bool = False) -> list[LimitVerdict]:
    """Judge a loop by a scope's imposed limits; with `stuck`, by those that also hold where friction sticks."""
    verdicts: list[LimitVerdict] = []
    for limit in spec.limits:
        allowed = spec.allowed(limit)
        if limit.scope != scope or allowed is None or (stuck and not limit.stuck_too):
            continue
        value = limit.figure(loop)
        met = limit.keeps(value, allowed) and (limit.condition is None or limit.condition(loop))
        verdicts.append(LimitVerdict(limit=limit, plant=loop.name, value=value, allowed=allowed, met=met, stuck=stuck))
    return verdicts


def judge_all(spec: LoopSpec, loops: Sequence[MeasuredLoop], design_states: int = 1) -> list[LimitVerdict]:
    """Judge every plant's loop, and the design plant's, which is the first, by its own limits too. Of several
    `design_states` the first is the design plant sliding, the others the same plant stuck by friction.
    """
    verdicts = [verdict for loop in loops for verdict in judge(spec, loop, "every plant")]
    verdicts += judge(spec, loops[0], "design plant")
    stuck = loops[1:design_states]
    return verdicts + [v for loop in stuck for v in judge(spec, loop, "design plant", stuck=True)]


def list_broken(verdicts: Sequence[LimitVerdict]) -> list[BindingLimit]:
    """Return the limits that are broken, with the plant that breaks them."""
    return [verdict.binding for verdict in verdicts if not verdict.met]


def list_broken_limits(spec: ControllerSpec, loops: Sequence[MeasuredLoop], design_states: int) -> set[str]:
    """Return the names of the limits that some loop breaks, as `judge_all` judges them."""
    return {verdict.limit.name for verdict in judge_all(spec, loops, design_states) if not verdict.met}


def list_broken_figures(spec: ControllerSpec, states: Sequence[MeasuredLoop]) -> list[BindingLimit]:
    """Return the limits that the design plant's figures break, sliding and stuck if it has friction."""
    figures_only = replace(spec, passive_band_hz=None)
    return list_broken(judge_all(figures_only, states, len(states)))


def list_active(spec: ControllerSpec, verdicts: Sequence[LimitVerdict]) -> list[BindingLimit]:
    """Return the limits that are met with no more than the reserve and a hundredth to spare."""
    near = {"figure": 1.0 - NEARLY_USED - spec.reserve, "curve": 1.0 - NEARLY_USED, "none": np.inf}
    return [
        verdict.binding
        for verdict in verdicts
        if verdict.limit.usage(verdict.value, verdict.allowed) > near[verdict.limit.reserve]
    ]


def explain_broken(
    spec: LoopSpec, verdicts: Sequence[LimitVerdict], design: MeasuredLoop, loop: Loop | DiscLoop
) -> dict[str, str]:
    """Return of each limit that is broken, by its name, the figure of the plant that breaks it most, and the plants
    that do. `loop` is the design plant's. What is broken most comes first; where a loop is unstable nothing else says
    more.
    """
    broken: dict[str, list[LimitVerdict]] = {}
    for verdict in sorted((verdict for verdict in verdicts if not verdict.met), key=lambda each: -each.severity):
        broken.setdefault(verdict.limit.name, []).append(verdict)
    if "stability" in broken:
        broken = {"stability": broken["stability"]}
    texts = {
        name: _explain(spec, worst, design, loop)
        + _format_plants([each.plant for each in (worst, *less) if each.names_plant])
        for name, (worst, *less) in broken.items()
    }
    if list(broken) == ["min_friction_margin"]:  # the tuner then gives the law that has most of it
        return {name: f"{text}, the largest found at this bandwidth" for name, text in texts.items()}
    return texts


def join_limits(binding: Sequence[BindingLimit]) -> str:
    """Return limits, each once with its plants."""
    plants: dict[str, list[str]] = {}
    for limit in binding:
        plants.setdefault(limit.name, []).extend([limit.plant] if limit.plant else [])
    return ", ".join(name + _format_plants(named) for name, named in plants.items())


def advise_easing(binding: Sequence[BindingLimit], among: Collection[str] = LIFTABLE) -> str:
    """Return what to write for other limits than these that bind, all at once: to ease only some lets the next one
    bind. Only those `among` are eased; "" where none binds.
    """
    names = dict.fromkeys(limit.name for limit in binding)
    limits = [BY_NAME[name] for name in names if name in among and name in BY_NAME]
    ways = [(verb, [limit.name for limit in limits if limit.sense == sense]) for verb, sense in EASED.items()]
    return " and ".join(f"{verb} {join_words(named)}" for verb, named in ways if named)


def shorten_blocked(blocked: Sequence[str]) -> str:
    """Return the first of some broken limits, as many as a message has room for, and how many more there are."""
    sizes = accumulate(map(len, blocked))
    shown = [
        text for i, (text, size) in enumerate(zip(blocked, sizes, strict=True)) if not i or size <= BLOCKED_CHARACTERS
    ]
    more = len(blocked) - len(shown)
    return join_words([*shown, format_count(more, "more limit")] if more else shown)


def _format_plants(plants: Sequence[str]) -> str:
    """Return up to two plants by name, in brackets, and how many more there are."""
    named = plants if len(plants) < 3 else (plants[0], f"{len(plants) - 1} more")
    return f" ({' and '.join(named)})" if plants else ""


@record(eq=False)
class DesignFigure:
    """One limit's figure of the design plant for tables, what is allowed, and their unit; None where there is none."""

    limit: Limit
    value: float | None
    allowed: float | None
    unit: str

    @property
    def allowed_text(self) -> str:
        """The allowed value, with its sense and unit; empty where nothing is imposed."""
        if self.allowed is None:
            return ""
        sense = "" if self.limit.sense == "equal to" else f"{self.limit.sense} "
        return f"{sense}{self.allowed:g} {self.unit}".rstrip()


def list_design_figures(spec: ControllerSpec, design: MeasuredLoop) -> list[DesignFigure]:
    """Return each limit of one loop's figures; of friction and of further signals only where there are, or one asks."""
    present = {
        "min_friction_margin": design.slope_unit != "", OTHER_NOISE: design.figures.other_noise_gains != (),
        FAST_BANDWIDTH: design.fast is not None,
    }  # fmt: skip
    rows: list[DesignFigure] = []
    for limit in spec.limits:
        allowed = spec.allowed(limit)
        alone = limit.has_field and limit.condition is None  # a figure of the loop alone
        if not alone or (allowed is None and not present.get(limit.name, True)):
            continue
        value = limit.figure(design)
        reached = limit.sense == "at most" or np.isfinite(value) or (limit.name in present and present[limit.name])
        rows.append(
            DesignFigure(limit=limit, value=value if reached else None, allowed=allowed, unit=design.unit(limit))
        )
    return rows


def _explain(spec: LoopSpec, verdict: LimitVerdict, design: MeasuredLoop, loop: Loop | DiscLoop) -> str:
    limit, port = verdict.limit, design.port
    if limit.name == "stability":
        return limit.name
    if limit.curve is not None and limit.curve.symbol:
        return f"{limit.name} ({_reached(spec, verdict, loop)})"
    band = spec.passive_band_hz if isinstance(spec, ControllerSpec) else None
    if limit.name == "passive_band_hz" and port is not None and band is not None:
        low, high = band
        growth = "" if port.held_stable else "; the loop grows with its link held"
        return (
            f"{limit.name} = [{low:g}, {high:g}], Re Z/|Z| {port.least_cosine:.3g} of 0 at {port.at_hz:.4g} Hz{growth}"
        )
    if limit.sense == "equal to" and not np.isfinite(verdict.value):
        return f"{limit.name}, of which there is none"
    # As many digits as tell the figure from what is allowed.
    digits = next((count for count in range(4, 9) if float(f"{verdict.value:.{count}g}") != verdict.allowed), 9)
    return f"{limit.name} {verdict.value:.{digits}g} of {verdict.allowed:g}"


def _reached(spec: LoopSpec, verdict: LimitVerdict, loop: Loop | DiscLoop) -> str:
    """Return how far a curve is off its level: where it first crosses says little when it lies along the level."""
    curve = verdict.limit.curve
    assert curve is not None and curve.until_hz is not None
    until, grid = curve.until_hz(verdict.allowed, spec.bandwidth_hz), loop.grid()
    f = np.append(grid[grid < until], until)
    if isinstance(loop, DiscLoop):
        ((least, most),) = loop.bound(f, curve.of)
        values = least if curve.floor else most
    else:
        p, c_r, c_y = loop.plant.response(f), loop.law.reference_response(f), loop.law.measurement_response(f)
        open_loop = loop.open_loop(f)
        values = np.abs(curve.numerator(p, c_y, c_r, open_loop)) / np.abs(1.0 + open_loop)
    extreme = f"falls to {np.min(values):.4f}" if curve.floor else f"reaches {np.max(values):.4f}"
    return f"{curve.symbol} {extreme} below {until:.4g} Hz, {curve.level(verdict.allowed):.4f} allowed"
