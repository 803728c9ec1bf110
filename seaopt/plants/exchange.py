"""Plants for other tools: a python-control `NonlinearIOSystem`, and an FMU (CasADi's exporter, FMI 3.0)."""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import casadi as ca
import numpy as np

from seaopt.errors import PlantError
from seaopt.files import write_bytes
from seaopt.parameters import ParameterSet
from seaopt.plants.friction import can_stick, list_smoothing
from seaopt.plants.plant import DRIVE_DELAY, CompletedParameters, Plant, output_function, refuse_samples
from seaopt.units import factor

DESCRIPTION = "modelDescription.xml"


def to_control(plant: Plant, params: ParameterSet) -> Any:
    """Return the plant as a continuous-time `control.NonlinearIOSystem` with named signals, at fixed parameters.

    It cannot carry a delay: that of the drive is left out, and the system's name ends in ``_without_drive_delay``.
    """
    import control  # deferred: it imports matplotlib

    refuse_samples(plant)
    p = plant.complete(params).vector
    f = ca.Function("f", plant.symbols, [plant.dynamics])
    h = output_function(plant)

    def update(t: float, x: Any, u: Any, _: Any) -> Any:
        return np.array(f(t, x, u, p)).ravel()

    def output(t: float, x: Any, u: Any, _: Any) -> Any:
        return np.array(h(t, x, u, p)).ravel()

    return control.NonlinearIOSystem(
        update,
        output,
        states=list(plant.states),
        inputs=list(plant.inputs),
        outputs=list(plant.outputs),
        name=plant.name.replace(" ", "_") + ("_without_drive_delay" if _find_drive_delay(params) else ""),
        dt=0,
    )


def export_fmu(plant: Plant, params: ParameterSet, path: Path | str, *, include: Path | str | None = None) -> Path:
    """Write the plant as an FMU for model exchange, FMI 3.0, with its C sources; parameters stay tunable.

    Parameters
    ----------
    plant, params
        The plant, and the start values of its parameters.
    path : path
        The .fmu file.
    include : path, optional
        A folder with the FMI 3.0 headers: with it and a C compiler, a binary for this platform is included. Without,
        the importing tool compiles the sources.

    Raises
    ------
    PlantError
        The installed CasADi has no exporter, the plant holds samples or depends on time explicitly, or the sources do
        not compile.

    Notes
    -----
    States start at zero. An output with the name of a state is called NAME_out. Friction is its smoothed curve: of a
    plant that sticks the model's description says so, for there the FMU creeps, and so it does of a drive's delay,
    which an FMU of a continuous plant cannot carry.
    """
    refuse_samples(plant)
    if ca.depends_on(ca.vertcat(plant.dynamics, plant.output), plant.t):
        raise PlantError(f"plant {plant.name} depends on time explicitly, which the export leaves out")
    target = Path(path)
    if include is not None and not Path(include).is_dir():
        raise PlantError(f"include = {include} is not a folder; give the one with the FMI 3.0 headers")
    builder = _builder(plant, plant.complete(params), "plant_" + re.sub("[^A-Za-z0-9]+", "_", plant.name).strip("_"))
    archive = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        try:
            content = builder.export_fmu({"no_warning": True, "with_serialization": False})
            if include is not None:
                content = builder.compile_fmu(content, {"include_dirs": [str(Path(include).resolve())]})
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise PlantError(
                f"the FMU cannot be made ({reason}); check compiler and include", plant=plant.name
            ) from error
        described = next(Path(source) for source in content if Path(source).name == DESCRIPTION)
        text = described.read_text(encoding="utf-8")
        remark = f"<fmiModelDescription description={quoteattr(_describe(plant, _find_drive_delay(params)))} "
        described.write_text(text.replace("<fmiModelDescription ", remark, 1), encoding="utf-8")
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
            for source, name_inside in content.items():
                packed.write(source, str(Path(name_inside)))
    return write_bytes(target, archive.getvalue())


def _find_drive_delay(params: ParameterSet) -> float:
    """Return the drive's delay among what is given, s."""
    stated = params.given if isinstance(params, CompletedParameters) else params
    return stated[DRIVE_DELAY].value * factor(stated[DRIVE_DELAY].unit, "s") if DRIVE_DELAY in stated else 0.0


def _describe(plant: Plant, drive_delay_s: float) -> str:
    """Return what the model is, and what it leaves out of the plant."""
    left_out: list[str] = []
    if plant.sticks and can_stick(plant):
        over = " and ".join(list_smoothing(plant))
        left_out.append(
            f"Friction that sticks is not in this FMU: it is smoothed over {over}, so that a joint that stands still "
            "in seaopt creeps here"
        )
    if drive_delay_s:
        left_out.append(
            f"The drive's delay of {1e3 * drive_delay_s:.4g} ms is not in this FMU: delay its input by that long"
        )
    return ". ".join([plant.name, *left_out])


def _builder(plant: Plant, params: CompletedParameters, name: str) -> Any:
    builder = ca.DaeBuilder(name, "", {})
    x = {state: builder.add(state) for state in plant.states}
    u = {source: builder.add(source, "input") for source in plant.inputs}
    p = {parameter: builder.add(parameter, "parameter", "tunable") for parameter in plant.parameters}
    taken = {*x, *u, *p}
    y = [builder.add(f"{o}_out" if o in taken else o, "output") for o in plant.outputs]
    equations = ca.Function("equations", plant.symbols[1:], [plant.dynamics, plant.output])
    rates, outputs = equations(*(ca.vertcat(*named.values()) for named in (x, u, p)))
    for state, rate in zip(x.values(), ca.vertsplit(rates), strict=True):
        builder.eq(builder.der(state), rate)
    for symbol, output in zip(y, ca.vertsplit(outputs), strict=True):
        builder.eq(symbol, output)
    for name, parameter in params.items():
        builder.set_start(name, parameter.value)
    # CasADi writes no unit definitions, without which FMI allows no units: they go into the descriptions.
    units = {**plant.states, **plant.inputs, **{name: plant.parameter_unit(name) for name in p}}
    for signal, unit in units.items():
        builder.set_description(signal, f"[{unit}]")
    for state in x:
        builder.set_start(state, 0.0)
        builder.set_initial(state, "exact")
    return builder
