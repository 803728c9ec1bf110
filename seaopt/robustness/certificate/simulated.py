"""What the linear figures leave out: the controller on the nonlinear plants, at large signals, and at its port."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from seaopt.bench import Sensors
from seaopt.control import Controller
from seaopt.control.laws.passivity import Passivity, passivity
from seaopt.errors import ControlError, SeaoptError
from seaopt.formatting import html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.verification.environments import StabilityMap, coupled_stability
from seaopt.robustness.verification.large_signal import LargeSignal, large_signal
from seaopt.robustness.verification.verification import Verification, check_plants, verify

Found = TypeVar("Found")


@record(eq=False)
class Simulated:
    """Scenarios and large signals on every plant; passivity and coupled stability on the design plant.

    Parameters
    ----------
    verification : Verification or None
        None if a plant cannot be simulated.
    large_signal : tuple of LargeSignal
        One a plant, the design plant first; empty without a current limit.
    passivity, environments : Passivity and StabilityMap, or None
        None for a plant without a port at link 2.
    left_out : mapping of what to reason
    sensors, current_step_A, seed
        What the scenarios were played with.

    """

    verification: Verification | None
    large_signal: tuple[LargeSignal, ...]
    passivity: Passivity | None
    environments: StabilityMap | None
    left_out: Mapping[str, str]
    sensors: Sensors
    current_step_A: float
    seed: int

    @property
    def passed(self) -> bool:
        """Every scenario passed; large signals and passivity are findings."""
        return self.verification is not None and self.verification.passed

    def simulation_dict(self) -> dict[str, Any]:
        """Return what goes into robustness.json under "simulation"."""
        played = {} if self.verification is None else self.verification.to_dict()
        return {"passed": self.passed} | played | {
            "large_signal": [item.to_dict() for item in self.large_signal],
            "sensors": asdict(self.sensors),
            "current_step_A": self.current_step_A,
            "seed": self.seed,
            "left_out": dict(self.left_out),
        }  # fmt: skip

    def passivity_dict(self) -> dict[str, Any] | None:
        """Return what goes into robustness.json under "passivity"; None for a plant without a port."""
        if self.passivity is None or self.environments is None:
            return None
        return self.passivity.to_dict() | {"environments": self.environments.to_dict()}

    def lines(self) -> list[str]:
        """Return the findings in short, a line each; failed scenarios are not among them."""
        out: list[str] = []
        if self.verification is not None:
            failed, count = len(self.verification.failures), len(self.verification.rows)
            out.append(f"simulation: {f'{failed} of {count} runs FAILED' if failed else f'{count} runs passed'}")
            out += self.verification.following()
        out += [f"large signals on {item.plant}: {_large(item)}" for item in self.large_signal]
        if self.passivity is not None:
            out.append(f"port at link 2: passive {_bands(self.passivity)}")
        if self.environments is not None:
            out.append(f"environments at link 2: {_held(self.environments)}")
        return [*out, *(f"no {what}: {reason}" for what, reason in self.left_out.items())]

    def __repr__(self) -> str:
        found = (self.verification, *self.large_signal, self.passivity, self.environments)
        left_out = [f"No {what}: {reason}" for what, reason in self.left_out.items()]
        return "\n".join([*(repr(item) for item in found if item is not None), *left_out])

    _repr_html_ = html_text


def simulated(
    controller: Controller,
    plants: Mapping[str, Plant],
    parameters: ParameterSet,
    *,
    draws: Mapping[str, Sequence[ParameterSet]] | None = None,
    sensors: Sensors | None = None,
    current_step_A: float = 0.0,
    seed: int = 1,
) -> Simulated:
    """Find what the linear figures leave out.

    Parameters
    ----------
    controller, plants, parameters, draws, sensors, current_step_A, seed
        As in `verify`; the controller knows its design plant.

    Returns
    -------
    Simulated
        What cannot be had is None, and `left_out` says why.

    Raises
    ------
    ControlError
        There is no plant, the controller does not know its design plant, or `draws` names a plant that is not there.

    """
    if controller.design is None:
        raise ControlError(
            "the controller does not know its design plant; tune it, or read it with Controller.from_dict"
        )
    check_plants(plants, draws or {}, {})
    plant, values = controller.design
    device = sensors or Sensors()
    left_out: dict[str, str] = {}

    def had(what: str, verb: Callable[[], Found]) -> Found | None:
        try:
            return verb()
        except SeaoptError as error:
            left_out[what] = str(error)
        except np.linalg.LinAlgError as error:
            left_out[what] = f"a matrix of it cannot be factorised ({error}); look at parameters that are zero or huge"
        return None

    swept = [
        had(what, partial(_swept, controller, name, *on)) for name, on, what in _sweeps(controller, plants, parameters)
    ]
    return Simulated(
        verification=had("simulation", lambda: verify(
            controller, plants, parameters, draws=draws, sensors=device, current_step_A=current_step_A, seed=seed
        )),
        large_signal=tuple(item for item in swept if item is not None),
        passivity=had("passivity", lambda: passivity(controller, plant, values)),
        environments=had("environments", lambda: coupled_stability(controller, plant, values)),
        left_out=left_out, sensors=device, current_step_A=current_step_A, seed=seed,
    )  # fmt: skip


def _sweeps(
    controller: Controller, plants: Mapping[str, Plant], parameters: ParameterSet
) -> list[tuple[str, tuple[Plant, ParameterSet], str]]:
    """Return what is swept: a name, plant and parameters, and what to call it where it cannot be had."""
    assert controller.design is not None
    design, values = controller.design
    if controller.spec.current_limit_A is None:  # one reason for all of them
        return [(design.name, (design, values), "large signals")]
    known = next((name for name, plant in plants.items() if plant is design), design.name)
    on = {known: (design, values)} | {name: (plant, parameters) for name, plant in plants.items() if name != known}
    return [(name, item, f"large signals on {name}") for name, item in on.items()]


def _swept(controller: Controller, name: str, plant: Plant, parameters: ParameterSet) -> LargeSignal:
    return replace(large_signal(controller, plant, parameters), plant=name)


def _large(found: LargeSignal) -> str:
    pairs = zip(found.amplitude_N, found.bandwidth_hz, strict=True)
    return ", ".join(f"{'–' if hz is None else f'{hz:.3g} Hz'} at {amplitude:.3g} N" for amplitude, hz in pairs)


def _bands(found: Passivity) -> str:
    if not found.held_stable:
        return "nowhere: the loop is UNSTABLE with link 2 held"
    bands = ", ".join(f"{low:.3g} to {high:.4g} Hz" for low, high in found.bands_hz) or "nowhere"
    lost = "" if found.violated_hz is None else f"; {-found.least_damping_N_s_per_m:.3g} N s/m are missing elsewhere"
    return bands + lost


def _held(found: StabilityMap) -> str:
    if found.everywhere:
        return f"stable against all of {found.stable.size} masses on springs and dampers"
    shares = ", ".join(
        f"{np.count_nonzero(stable)} of {stable.size} at {damping:g} N s/m"
        for damping, stable in zip(found.damping, found.stable, strict=True)
    )
    return f"stable in {shares}"
