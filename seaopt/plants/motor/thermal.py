r"""Heat of the current: a winding in a case, for any plant whose motor is commanded a current inside.

Two masses of heat, the winding on the case on the ambient air; their temperatures are counted from the ambient's, so
that a motor at rest is at zero:

.. math::
    C_w \dot\vartheta_w &= R(\vartheta_w) I^2 - (\vartheta_w - \vartheta_c)/R_{wc} \\
    C_c \dot\vartheta_c &= (\vartheta_w - \vartheta_c)/R_{wc} - \vartheta_c/R_{ca} \\
    R(\vartheta_w) &= R \, (1 + \alpha (T_a + \vartheta_w - 25\,\mathrm{°C}))

R is the winding's resistance at 25 °C, that of ``voltage_input`` and ``duty_input`` where one of them is there: the
warm winding then takes less current. (Winding and case of data sheets; e.g. R. Valentine, Motor Control Electronics
Handbook, McGraw-Hill 1998, ch. 3.)

Without a current to first order, :math:`I^2 = 0`, heat and motion do not see each other where a plant is linearised at
rest: `freeze_heat` is the plant with the winding at the ambient's temperature, for what looks at linear loops.

At a constant current all is linear, :math:`\dot\vartheta = (A_0 + e_1 e_1^T R \alpha I^2/C_w)\vartheta + b I^2`: the
figures of a `MotorRating` are exact. The matrix is similar to a symmetric one, so that its two eigenvalues are real:
two time constants. Where the feedback of the resistance makes one positive the winding runs away.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Constraints
from seaopt.errors import PlantError, require_number
from seaopt.formatting import html_text, join_words
from seaopt.parameters import ParameterSet, declare
from seaopt.plants.memo import memo
from seaopt.plants.plant import Plant, extend, find_range, refuse_clash
from seaopt.plants.roles import Friction, Winding, change_ports, with_values
from seaopt.records import record

COPPER = 0.00393  # 1/K, at 20 to 25 degC
REFERENCE_DEGC = 25.0
AMBIENT = "T_ambient"
PEAK_S = 10.0
Positive = Annotated[float, Constraints(gt=0.0)]
RISES = ("rise_winding", "rise_case")
TEMPERATURES = ("T_winding", "T_case")
RESISTANCE = declare("R", 1.0, "ohm", 1e-9, "winding resistance", (1e-3, 1e3))
PARAMETERS = (
    RESISTANCE,
    declare("alpha_cu", COPPER, "1/K", 0.0, "of the winding's resistance"),
    declare("R_wc", 1.0, "K/W", 1e-9, "from winding to case", (1e-3, 1e3)),
    declare("R_ca", 4.0, "K/W", 1e-9, "from case to air", (1e-3, 1e3)),
    declare("C_w", 20.0, "J/K", 1e-9, "heat of the winding", (1e-2, 1e5)),
    declare("C_c", 400.0, "J/K", 1e-9, "heat of the case", (1e-1, 1e6)),
    declare(AMBIENT, 25.0, "degC", -273.15, "of the air", (-60, 80)),
    declare("T_max", 125.0, "degC", -273.15, "largest of the winding"),
)

NETWORK = ("R", "R_wc", "R_ca", "C_w", "C_c")  # these and T_max differ from motor to motor


def list_guessed_heat(plant: Plant, stated: Collection[str]) -> list[str]:
    """Return what of a motor's winding is not among the stated names, so that its default is a guess."""
    if not set(RISES) <= set(plant.states):
        return []
    network_alone = plant.winding is None  # the kind "winding", which has no largest temperature to keep
    return [name for name in (*NETWORK, *(() if network_alone else ("T_max",))) if name not in stated]


def find_resistance(winding: Winding | None, x: Any, p: Any) -> Any:
    """Return the resistance (ohm) of a winding at a state, as an expression; at the ambient temperature for x None."""
    if winding is None:
        return p.R
    rise = 0.0 if x is None else getattr(x, winding.rises[0])
    return p.R * (1.0 + p.alpha_cu * (p.T_ambient - REFERENCE_DEGC + rise))


def _warm(current: Any, x: Any, p: Any) -> dict[str, Any]:
    """Return how fast winding and case warm up."""
    loss = p.R * (1.0 + p.alpha_cu * (p.T_ambient - REFERENCE_DEGC + x.rise_winding)) * current**2
    to_case, to_air = (x.rise_winding - x.rise_case) / p.R_wc, x.rise_case / p.R_ca
    return dict(zip(RISES, ((loss - to_case) / p.C_w, (to_case - to_air) / p.C_c), strict=True))


def _read_temperatures(x: Any, p: Any) -> dict[str, Any]:
    return dict(zip(TEMPERATURES, (p.T_ambient + x.rise_winding, p.T_ambient + x.rise_case), strict=True))


def winding() -> Plant:
    """Return the winding and its case alone, from the current I (A): for logs of temperatures, which take minutes.

    Its parameters are those of the part "thermal", so that one fit may hold slow logs of this plant, and fast logs of
    the whole actuator.

    Returns
    -------
    Plant
        Input I (A); outputs T_winding and T_case (degC).

    Examples
    --------
    >>> import seaopt as so
    >>> list(so.plants.winding().outputs)
    ['T_winding', 'T_case']
    """
    return Plant(
        name="winding",
        states=dict.fromkeys(RISES, "K"),
        inputs={"I": "A"},
        outputs=dict.fromkeys(TEMPERATURES, "degC"),
        parameters={parameter.name: parameter for parameter in PARAMETERS},
        f=lambda t, x, u, p: _warm(u.I, x, p),
        h=lambda t, x, u, p: _read_temperatures(x, p),
    )


def add_heat(plant: Plant) -> Plant:
    """Return a plant whose motor warms up. Raises PlantError: its actuation is no current, or a name is taken."""
    actuation = plant.actuation
    if actuation is None or plant.inputs[actuation.input] != "A":
        raise PlantError(
            'part "thermal" needs the current that heats the winding; give the role '
            "actuation = Actuation(input, effort) with an input in A",
            plant=plant.name,
        )
    refuse_clash(plant, "thermal", (*RISES, *TEMPERATURES, *(parameter.name for parameter in PARAMETERS)))
    return extend(
        plant,
        rates=lambda t, x, u, p: _warm(getattr(u, actuation.input), x, p),
        readings=lambda t, x, u, p: _read_temperatures(x, p),
        added=PARAMETERS,
        name=f"{plant.name} with heat",
        winding=Winding(rises=RISES, temperatures=TEMPERATURES, effort=actuation.effort, unit=actuation.unit),
        states={**plant.states, **dict.fromkeys(RISES, "K")},
        outputs={**plant.outputs, **dict.fromkeys(TEMPERATURES, "degC")},
        ports=change_ports(plant.ports, add_heat),
    )


@memo
def freeze_heat(plant: Plant) -> Plant:
    """Return the plant with its winding at the ambient temperature, without heat among states and outputs."""
    winding = plant.winding
    if winding is None:
        return plant
    still = dict.fromkeys(winding.rises, 0.0)

    def freeze(friction: Friction) -> Friction:
        velocity, loads = friction.velocity, friction.loads
        return replace(
            friction,
            velocity=lambda x, p: velocity(with_values(x, still), p),
            loads=None if loads is None else lambda x, u, p: loads(with_values(x, still), u, p),
        )

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {name: rate for name, rate in plant.f(t, with_values(x, still), u, p).items() if name not in still}

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        return {
            name: value
            for name, value in plant.h(t, with_values(x, still), u, p).items()
            if name not in winding.temperatures
        }

    return replace(
        plant,
        f=f,
        h=h,
        winding=None,
        states={name: unit for name, unit in plant.states.items() if name not in still},
        outputs={name: unit for name, unit in plant.outputs.items() if name not in winding.temperatures},
        friction={name: freeze(friction) for name, friction in plant.friction.items()},
        ports=change_ports(plant.ports, freeze_heat),
    )


@record
class MotorRating:
    """Continuous and peak effort of a motor that does not overheat: its network of heat, and the effort of an ampere.

    Parameters
    ----------
    resistance : float
        Of the winding at the ambient temperature, ohm.
    slope : float
        How it grows with the winding's temperature, ohm/K.
    to_case, to_air : float
        K/W.
    winding, case : float
        J/K.
    ambient, hottest : float
        degC.
    per_ampere : float
        The effort at the spring that an ampere makes.
    unit : str
        Of the effort.
    largest_A : float or None
        The largest current that can be commanded, where that is known.
    largest_V : float or None
        The same of the voltage; of a duty, of what it makes. The motor stands still.
    """

    resistance: Positive
    slope: float
    to_case: Positive
    to_air: Positive
    winding: Positive
    case: Positive
    ambient: float
    hottest: float
    per_ampere: float
    unit: str
    largest_A: Positive | None = None
    largest_V: Positive | None = None

    @property
    def allowed_rise(self) -> float:
        """How far the winding may be above the ambient, K."""
        return self.hottest - self.ambient

    @property
    def continuous_A(self) -> float:
        """The current that holds the winding at its largest temperature for ever.

        All of the loss flows through both resistances: R(T_max) I^2 (R_wc + R_ca) = T_max - T_ambient. No more than
        the largest command makes in the winding that is so warm.
        """
        loss, hot = self.allowed_rise / (self.to_case + self.to_air), self.resistance + self.slope * self.allowed_rise
        current_A = math.sqrt(loss / hot)
        return self._limit(current_A if self.largest_V is None else min(current_A, self.largest_V / hot))

    @property
    def continuous_effort(self) -> float:
        """The effort of that current at the spring."""
        return self.continuous_A * self.per_ampere

    def peak_A(self, duration_s: float = PEAK_S, start: tuple[float, float] = (0.0, 0.0)) -> float:
        """Return the constant current after which, from temperatures above the ambient, the winding is at its largest.

        No more than the largest command makes, of a voltage in the winding that is as warm as it then ends.

        Parameters
        ----------
        duration_s : float
            How long it flows.
        start : (float, float)
            Winding and case above the ambient, K; both cold if left out.

        Raises
        ------
        PlantError
            The duration is not positive, or the winding is too hot already.
        """
        if not 0.0 < require_number(duration_s, "duration_s", PlantError) < math.inf:
            raise PlantError(f"duration_s = {duration_s:g} is not positive; give how long the peak lasts")

        def excess(current_A: float) -> float:
            return min(float(self.rises(current_A, duration_s, start)[0]), 2.0 * self.allowed_rise) - self.allowed_rise

        if not (start[0] < self.allowed_rise and excess(0.0) < 0.0):
            raise PlantError(
                f"start = ({start[0]:g}, {start[1]:g}) K above the ambient: the winding is at {self.hottest:g} degC or "
                "above without a current; let it cool"
            )
        from scipy.optimize import brentq  # deferred: it takes long to import

        high = max(self.continuous_A, 1e-6)
        while excess(high) < 0.0:
            high *= 2.0
        most: Any = brentq(excess, 0.0, high, xtol=1e-12 * high)
        volts = math.inf if self.largest_V is None else self.largest_V

        def exceed_voltage(current_A: float) -> float:
            warm = self.resistance + self.slope * float(self.rises(current_A, duration_s, start)[0])
            return current_A * warm - volts

        if exceed_voltage(most) > 0.0:  # the winding, as warm as it is at the end, does not take so much
            most = brentq(exceed_voltage, 0.0, most, xtol=1e-12 * most)
        return self._limit(float(most))

    def peak_effort(self, duration_s: float = PEAK_S, start: tuple[float, float] = (0.0, 0.0)) -> float:
        """Return the effort of that current at the spring."""
        return self.peak_A(duration_s, start) * self.per_ampere

    def rises(
        self, current_A: float, duration_s: float, start: tuple[float, float] = (0.0, 0.0)
    ) -> Float[np.ndarray, " 2"]:
        """Return how far winding and case are above the ambient (K) after a constant current.

        Infinite where the winding runs away beyond what a number holds.
        """
        heating = np.array([self.resistance * current_A**2 / self.winding, 0.0])
        rates, modes = np.linalg.eig(self.matrix(current_A))  # two different ones: the module's docstring
        with np.errstate(over="ignore", invalid="ignore"):  # a winding that runs away
            grown, collected = np.exp(rates * duration_s), np.expm1(rates * duration_s) / rates
            after = modes @ (grown * np.linalg.solve(modes, start) + collected * np.linalg.solve(modes, heating))
        return after if np.all(np.isfinite(after)) else np.full(2, math.inf)

    def matrix(self, current_A: float = 0.0) -> Float[np.ndarray, "2 2"]:
        """Return what heat does by itself, 1/s, with what the growing resistance adds at a constant current."""
        flow = 1.0 / self.to_case
        fed_back = self.slope * current_A**2
        return np.array(
            [
                [(fed_back - flow) / self.winding, flow / self.winding],
                [flow / self.case, -(flow + 1.0 / self.to_air) / self.case],
            ]
        )

    def time_constants_s(self, current_A: float = 0.0) -> tuple[float, float]:
        """Return the two time constants, the shorter first; infinite where the winding runs away."""
        rates = np.sort(np.linalg.eigvals(self.matrix(current_A)).real)
        short, long = (-1.0 / rate if rate < 0.0 else math.inf for rate in rates)
        return short, long

    def describe(self) -> list[str]:
        """Return the continuous and the peak effort, a line each, with the currents that make them."""
        fast, slow = self.time_constants_s()
        return [
            f"continuous {self.continuous_effort:.4g} {self.unit} ({self.continuous_A:.4g} A) at a winding of "
            f"{self.hottest:g} degC in {self.ambient:g} degC",
            f"peak {self.peak_effort():.4g} {self.unit} ({self.peak_A():.4g} A) for {PEAK_S:g} s from cold; time "
            f"constants {fast:.3g} and {slow:.3g} s",
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return what goes into controller.json: the network, and what it allows."""
        return asdict(self) | {
            "continuous_A": self.continuous_A,
            "continuous_effort": self.continuous_effort,
            "peak_s": PEAK_S,
            "peak_A": self.peak_A(),
            "peak_effort": self.peak_effort(),
            "time_constants_s": list(self.time_constants_s()),
        }

    def _limit(self, current_A: float) -> float:
        return current_A if self.largest_A is None else min(current_A, self.largest_A)

    def __repr__(self) -> str:
        return "MotorRating: " + "\n  ".join(self.describe())

    _repr_html_ = html_text


def rate_motor(plant: Plant, params: ParameterSet, largest: float | None = None) -> MotorRating:
    """Return the continuous and peak currents and efforts of a motor, by the part "thermal".

    Parameters
    ----------
    plant : Plant
        With that part.
    params : ParameterSet
        Its parameters, or those of a fit.
    largest : float, optional
        The largest command, in its unit; that of the plant's actuation if left out.

    Raises
    ------
    PlantError
        The plant has no such part, a parameter of it that differs from motor to motor is not given, or its largest
        temperature is not above the ambient's.

    Examples
    --------
    >>> import seaopt as so
    >>> plant = so.plants.rotary(link="locked", parts=["thermal"])
    >>> rating = rate_motor(plant, plant.defaults)
    >>> print(f"{rating.continuous_A:.3f} A, {rating.peak_A(10.0):.3f} A for 10 s")
    3.789 A, 14.446 A for 10 s
    """
    winding = plant.winding
    if winding is None:
        raise PlantError(f'plant {plant.name} has no winding that warms up; give it parts = ["thermal"]')
    values = plant.complete(params)
    guessed = list_guessed_heat(plant, values.given)
    if guessed:
        raise PlantError(
            f"{join_words(guessed)} of the winding {'is' if len(guessed) == 1 else 'are'} not given, and what a motor "
            "can do is only known with them; give them from its data sheet"
        )
    p = values.by_attribute
    if not p.T_max > p.T_ambient:
        raise PlantError(f"T_max = {p.T_max:g} degC is not above T_ambient = {p.T_ambient:g} degC; raise the one")
    resistance = float(find_resistance(winding, None, p))
    if not resistance > 0.0:
        raise PlantError(f"R = {p.R:g} ohm at 25 degC is {resistance:g} ohm at T_ambient = {p.T_ambient:g} degC; check")
    largest = find_range(plant, values) if largest is None else largest
    largest_A, largest_V = None, None
    if plant.actuation is not None and largest is not None:
        source = plant.actuation.input
        if plant.inputs[source] == "A":
            largest_A = largest
        elif plant.inputs[source] == "V" or source == "duty":  # `seaopt.plants.drives`
            largest_V = largest * (p.V_s if source == "duty" else 1.0)
    return MotorRating(
        resistance=resistance,
        slope=p.R * p.alpha_cu,
        to_case=p.R_wc,
        to_air=p.R_ca,
        winding=p.C_w,
        case=p.C_c,
        ambient=p.T_ambient,
        hottest=p.T_max,
        per_ampere=float(winding.effort(p)),
        unit=winding.unit,
        largest_A=largest_A,
        largest_V=largest_V,
    )


def find_warm_range(plant: Plant, params: ParameterSet) -> tuple[float, float] | None:
    """Return the winding's temperatures that a loop meets, from the ambient's to T_max, degC. None where the winding
    does not warm up, or a current is commanded, which its resistance does not change. A plant that is linearised has
    its winding at T_ambient: drawn from this range, that makes R warm, with whatever else is uncertain of R.
    """
    if plant.winding is None or plant.actuation is None or plant.inputs[plant.actuation.input] == "A":
        return None
    rating = rate_motor(plant, params)
    return rating.ambient, rating.hottest
