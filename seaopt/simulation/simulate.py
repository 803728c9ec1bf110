"""Simulate any plant over the inputs of a log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from seaopt.errors import LogError, SimulationError, require_number, require_type, suggestion
from seaopt.logs import Log
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import fill_vector
from seaopt.signals import Signal, VectorN, VectorX
from seaopt.simulation.discretisation import Clock, Hold
from seaopt.simulation.model import Model, make_model
from seaopt.simulation.passes import Pass, Point, Segment
from seaopt.simulation.run import run_passes

MAX_SIMULATION_SUBSTEPS = 1024
ROUNDING = 1e-6  # of an output: below it an error is not held against the output itself


def input_samples(plant: Plant, log: Log) -> tuple[VectorN, ...]:
    """Return the plant's inputs from a log's channels of the same names, in the plant's order; of an optional input
    that it has none of zeros, or the time since it began. Raises LogError: an input is missing from the log, or has
    missing samples.
    """
    columns: list[VectorN] = []
    driven = any(name in log.signals for name in plant.inputs)  # by one at least, though all may be optional
    for name in plant.inputs:
        if name not in log.signals:
            if driven and name in plant.optional_inputs:
                columns.append(log.time - log.time[0] if name == plant.clock else np.zeros(len(log)))
                continue
            raise LogError(
                f'{log.source}: no channel "{name}" for the input of {plant.name}; {suggestion(name, log.signals)}'
            )
        values = log[name]
        if not np.all(np.isfinite(values)):
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise LogError(
                f"{log.source}: input {name} is missing at t = {log.time[row]:g} s (sample {row + 1}); "
                "cut that part off with slice_s, or fill it and say so"
            )
        columns.append(values)
    return tuple(columns) if columns else (np.zeros(len(log)),)


def simulate(
    plant: Plant,
    params: ParameterSet,
    log: Log,
    *,
    initial_state: Mapping[str, float] | None = None,
    hold: Hold = "zero",
    delay_s: float = 0.0,
    rtol: float = 1e-7,
) -> Log:
    """Simulate a plant over the inputs of a log.

    Parameters
    ----------
    plant : Plant
        Any plant.
    params : ParameterSet
        Its parameters; what is left out has the plant's default.
    log : Log
        Channels with the names of the plant's inputs, on a uniform clock without gaps.
    initial_state : mapping of state name to float, optional
        Zero where left out.
    hold : {"zero", "first"}
        The input between samples.
    delay_s : float
        Delay of the input.
    rtol : float
        Error allowed in each output, relative to its largest value; a linear plant has no error, and for a
        nonlinear one the step is refined until two step sizes agree within it.

    Returns
    -------
    Log
        The plant's inputs, outputs and states as channels, on the log's clock.

    Raises
    ------
    LogError
        An input is missing, or the log has a gap.
    SimulationError
        The trajectory overflows, or no step size reaches `rtol`.

    Examples
    --------
    >>> import numpy as np
    >>> import seaopt as so
    >>> t = np.arange(400) / 400
    >>> run = so.simulate(so.plants.high_impedance(), so.plants.thor(), so.Log.from_arrays(time=t, I=np.ones(400)))
    >>> round(float(run["F1"][-1]), 1)  # 240.33 N/A once it has settled
    240.3
    """
    require_type(plant, Plant, "plant", "give a Plant", SimulationError)
    require_type(log, Log, "log", "give a Log", SimulationError)
    if require_number(delay_s, "delay_s", SimulationError) > log.duration_s:
        raise SimulationError(f"delay_s = {delay_s:g} is longer than the log of {log.duration_s:.4g} s; give less")
    model = make_model(plant, params)
    if len(log.segments) > 1:
        raise LogError(f"{log.source}: has {len(log.segments)} segments with gaps between; simulate them one by one")
    x0 = fill_vector("state", plant.states, initial_state)
    u = input_samples(plant, log)
    clock = Clock(period=log.period, hold=hold, delay_s=delay_s)
    result = _run_to_tolerance(model, Segment(u=u, start_s=float(log.time[0])), x0, clock, rtol)
    outputs, states = result.outputs, result.states
    assert outputs is not None and states is not None
    if not (np.all(np.isfinite(outputs)) and np.all(np.isfinite(states))):
        bad = ~(np.isfinite(outputs).all(axis=1) & np.isfinite(states).all(axis=1))
        raise SimulationError(
            f"plant {plant.name} leaves what numbers can hold at t = {log.time[np.argmax(bad)]:g} s; "
            "check the parameters, their units and the input"
        )
    signals: dict[str, Signal] = {}
    for names, values in ((plant.inputs, u), (plant.states, states.T), (plant.outputs, outputs.T)):
        for (name, unit), channel in zip(
            names.items(), values, strict=False
        ):  # a plant without inputs has one of zeros
            signals[name] = Signal(name=name, values=channel.copy(), unit=unit)
    return Log(time=log.time.copy(), signals=signals, source=f"simulation of {plant.name}")


def _run_to_tolerance(model: Model, segment: Segment, x0: VectorX, clock: Clock, rtol: float) -> Pass:
    def run(substeps: int, model: Model = model) -> Pass:
        point = Point(
            theta=np.zeros(0), offset=np.zeros(model.ny), gain=np.ones(model.ny), clock=clock, substeps=substeps
        )
        return run_passes(model, segment, point, x0, sums=False, outputs=True, states=True)

    result, least = run(1), np.full(model.ny, 1e-300)
    substeps = 1
    if model.sticks:  # what friction holds moves by rounding alone, which is told by how the plant moves without it
        moving = run(1, replace(model, sticks=False, memory={}))
        assert moving.outputs is not None
        least = np.maximum(least, ROUNDING * np.nan_to_num(np.max(np.abs(moving.outputs), axis=0)))
    while not model.linear:
        substeps *= 2
        finer = run(substeps)
        assert result.outputs is not None and finer.outputs is not None
        scale = np.maximum(np.max(np.abs(finer.outputs), axis=0), least)
        with np.errstate(invalid="ignore"):
            error = float(np.max(np.abs(finer.outputs - result.outputs) / scale)) / (2.0**model.order - 1.0)
        result = finer
        if error <= rtol:
            break
        if substeps >= MAX_SIMULATION_SUBSTEPS:
            raise SimulationError(
                f"plant {model.plant.name}: {substeps} steps per sample leave an error of {error:.1e} of the signal "
                f"(rtol = {rtol:g}); check the parameters, smooth the friction (v_s), or raise rtol"
            )
    return result
