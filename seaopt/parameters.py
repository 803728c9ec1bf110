"""Named values with units, bounds and priors: what a plant is made of and what a fit returns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any

from seaopt.codec import Fields, OrInfinite, OrMinusInfinite
from seaopt.errors import ParameterError, UnitError, require_number, require_type, suggestion
from seaopt.formatting import format_table, html_table
from seaopt.records import record
from seaopt.units import factor, unit_after

QUANTILE = 1.959964  # of the standard normal, 95 % two-sided


@record(keywords=True)
class Parameter:
    """One named value in an SI unit.

    Parameters
    ----------
    name : str
        The field's symbol, such as "J".
    value : float
        In `unit`.
    unit : str
        SI unit text; "-" for a pure number.
    free : bool
        Whether a fit may change it.
    min, max : float
        Bounds, in `unit`; a value on a bound is allowed.
    prior_std : float or None
        The value is known within this standard deviation (a Gaussian prior in the fit), in `unit`.
    std : float or None
        Posterior standard deviation, where a fit gave one: what noise moves the value by.
    model_std : float or None
        What the structure that a fit left in its residuals may move the value by, as a standard deviation.
    description : str
        A few words.
    identified : bool
        False where a fit gave the value and its data cannot identify it: other values fit as well.
    plausible : (low, high) or None
        What such actuators have, in `unit`: a fit that ends outside is warned of.
    """

    json_keys = (
        *("value", "unit", "free", "std", "model_std", "ci95", "known", "at_bound", "min", "max", "prior_std"),
        *("description", "identified", "plausible"),
    )

    name: str
    value: float
    unit: str
    free: bool = False
    min: OrMinusInfinite = -math.inf
    max: OrInfinite = math.inf
    prior_std: float | None = None
    std: float | None = None
    model_std: float | None = None
    description: str = ""
    identified: bool = True
    plausible: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for what, text in (("name", self.name), ("unit", self.unit)):
            if type(text) is not str:
                require_type(text, str, f"{what} of a parameter", "give a text", ParameterError)
        for what in ("value", "min", "max", "prior_std", "std", "model_std"):
            number = getattr(self, what)
            if number is not None and type(number) is not float:
                require_number(number, f"{what} of parameter {self.name}", ParameterError)
        if not math.isfinite(self.value):
            unit = unit_after(self.unit)
            what = f"a number in{unit}" if unit else "a number"
            raise ParameterError(f"parameter {self.name} = {self.value} is not finite; give {what}: {self.name} = 1.0")
        if not self.min <= self.max:
            raise ParameterError(
                f"parameter {self.name}: min = {self.min:g} is above max = {self.max:g}; swap them: "
                f"min = {self.max:g}, max = {self.min:g}"
            )
        if not self.min <= self.value <= self.max:
            # A bound just above 0 keeps a division possible: wider bounds are no remedy there.
            remedy = (
                "give it a positive value"
                if self.value <= 0.0 < self.min
                else "change the value or the bounds: "
                f"min = {min(self.min, self.value):g}, max = {max(self.max, self.value):g}"
            )
            raise ParameterError(
                f"parameter {self.name} = {self.value:g}{unit_after(self.unit)} is outside its bounds "
                f"[{self.min:g}, {self.max:g}]; {remedy}"
            )
        if self.prior_std is not None and not 0.0 < self.prior_std < math.inf:
            raise ParameterError(
                f"parameter {self.name}: prior_std = {self.prior_std:g} is not a positive number; "
                f"leave it out where nothing is known, or fix the parameter: {self.name} = {self.value:g}"
            )

    @property
    def total_std(self) -> float | None:
        """The standard deviation of noise and model together, where a fit gave one."""
        return None if self.std is None else math.hypot(self.std, self.model_std or 0.0)

    @property
    def ci95(self) -> tuple[OrMinusInfinite, OrInfinite] | None:
        """The 95 % interval, value ± 1.96 standard deviations of noise and model together, where a fit gave them."""
        std = self.total_std
        return None if std is None else (self.value - QUANTILE * std, self.value + QUANTILE * std)

    @property
    def known(self) -> OrInfinite | None:
        """Half the width of the 95 % interval over the value, where a fit gave a std."""
        std = self.total_std
        return None if std is None else QUANTILE * std / abs(self.value) if self.value else math.inf

    @property
    def at_bound(self) -> bool:
        """Whether a free value lies on one of its bounds."""
        width = 1e-9 * max(abs(self.value), 1e-300)
        return self.free and (self.value - self.min <= width or self.max - self.value <= width)


def declare(
    name: str, value: float, unit: str, least: float, description: str, plausible: tuple[float, float] | None = None
) -> Parameter:
    """Return a parameter from a row of a plant's table: its default, the least value, and what such actuators have."""
    return Parameter(name=name, value=value, unit=unit, min=least, description=description, plausible=plausible)


class ParameterSet(Mapping[str, Parameter]):
    """An ordered, immutable set of parameters; every change returns a new set.

    Examples
    --------
    >>> params = ParameterSet([Parameter(name="J", value=3e-6, unit="kg m^2", min=0.0)])
    >>> params = params.update(J=2e-6).free("J")
    >>> params["J"].value, params.free_names
    (2e-06, ('J',))
    """

    __slots__ = ("_items",)

    def __init__(self, parameters: Iterable[Parameter] = ()) -> None:
        items: dict[str, Parameter] = {}
        for parameter in parameters:
            require_type(parameter, Parameter, "an item of a ParameterSet", "give Parameters", ParameterError)
            if parameter.name in items:
                raise ParameterError(f"parameter {parameter.name} is given twice; keep one")
            items[parameter.name] = parameter
        self._items = items

    @classmethod
    def of(cls, **values: float | tuple[float, str]) -> ParameterSet:
        """Build a set from NAME=value or NAME=(value, unit); a bare value has no unit ("-").

        Examples
        --------
        >>> ParameterSet.of(k=(655e3, "N/m"), eta=0.95)["k"].unit
        'N/m'
        """
        pairs = {name: value if isinstance(value, tuple) else (value, "-") for name, value in values.items()}
        return cls(
            Parameter(name=name, value=require_number(value, name, ParameterError), unit=unit)
            for name, (value, unit) in pairs.items()
        )

    @classmethod
    def _from_json(cls, content: Mapping[str, Annotated[Mapping[str, Any], Fields(of=Parameter)]]) -> ParameterSet:
        """Return the parameters of a file; one that is free and has no std there has an infinite one."""

        def build(name: str, stored: Mapping[str, Any]) -> Parameter:
            std = (math.inf if stored["std"] is None else stored["std"]) if stored["free"] else None
            identified = stored["identified"] and std != math.inf  # an older file does not say it
            return Parameter(**dict(stored, name=name, std=std, identified=identified))

        return cls(build(name, stored) for name, stored in content.items())

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._items[name]
        except KeyError:
            raise ParameterError(
                f'parameter "{name}" is not in this set; {suggestion(name, self._items)}; one without a default is '
                f'added: with_parameters(so.Parameter(name="{name}", value=..., unit="..."))'
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self._items

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the free parameters, in order."""
        return tuple(name for name, parameter in self._items.items() if parameter.free)

    @property
    def unidentified_names(self) -> tuple[str, ...]:
        """Names of the parameters whose values come from a fit that cannot identify them, in order."""
        return tuple(name for name, parameter in self._items.items() if not parameter.identified)

    def values_of(self, names: Iterable[str]) -> list[float]:
        """Return the values of `names`, in their order and in SI."""
        return [self[name].value for name in names]

    def with_parameters(self, *parameters: Parameter) -> ParameterSet:
        """Return a set in which `parameters` replace those of the same name, or are added."""
        return ParameterSet({**self._items, **{parameter.name: parameter for parameter in parameters}}.values())

    def update(self, **values: float | tuple[float, str]) -> ParameterSet:
        """Return a set with new values; a tuple (value, unit) is converted to the declared unit. Raises ParameterError:
        a name is unknown or a value outside its bounds. Raises UnitError: a unit is unknown or of another dimension.
        """
        changed: list[Parameter] = []
        for name, stated in values.items():
            old = self[name]
            value, unit = stated if isinstance(stated, tuple) else (stated, old.unit)
            try:
                scale = factor(unit, old.unit)
            except UnitError as error:
                raise UnitError(f"parameter {name}: {error}") from error
            value = require_number(value, name, ParameterError) * scale
            changed.append(replace(old, value=value, std=None, identified=True))
        return self.with_parameters(*changed)

    def free(self, *names: str) -> ParameterSet:
        """Return a set in which `names` are free."""
        return self.with_parameters(*(replace(self[name], free=True) for name in names))

    def fix(self, *names: str) -> ParameterSet:
        """Return a set in which `names` (all, if none is given) are held at their values."""
        return self.with_parameters(*(replace(self[name], free=False) for name in names or self))

    def bound(self, **bounds: tuple[float, float]) -> ParameterSet:
        """Return a set with new bounds, NAME=(min, max), in the declared units."""
        return self.with_parameters(
            *(replace(self[name], min=float(low), max=float(high)) for name, (low, high) in bounds.items())
        )

    def prior(self, **stds: float) -> ParameterSet:
        """Return a set with Gaussian priors, NAME=std, centred on the present values and made free."""
        return self.with_parameters(
            *(replace(self[name], prior_std=float(std), free=True) for name, std in stds.items())
        )

    def subset(self, names: Iterable[str]) -> ParameterSet:
        """Return the parameters `names`, in that order."""
        return ParameterSet(self[name] for name in names)

    def _rows(self) -> list[tuple[str, str, str, str, str]]:
        rows: list[tuple[str, str, str, str, str]] = []
        for name, parameter in self._items.items():
            std = "" if parameter.std is None else f"± {parameter.std:.2g}"
            note = "at bound" if parameter.at_bound else ("free" if parameter.free else "")
            note = note if parameter.identified else f"{note}, not identified".removeprefix(", ")
            rows.append((name, f"{parameter.value:.6g}", std, parameter.unit, note))
        return rows

    def __repr__(self) -> str:
        return "\n".join(format_table(self._rows())) or "ParameterSet()"

    def _repr_html_(self) -> str:
        return html_table(("name", "value", "std", "unit", ""), self._rows())
