"""The files of a bring-up: of each stage the law, its reference as a table and as C, and what to expect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.control import ForceMPC, export
from seaopt.control.deploy.export import export_beside
from seaopt.control.deploy.target import LOG_ROWS, Tare
from seaopt.control.mpc.export import collect_code, list_sources
from seaopt.control.mpc.stored import describe_mpc
from seaopt.files import write_json, write_text
from seaopt.logs import Log, write_log
from seaopt.machine.bringup.expected import Band, Expected
from seaopt.machine.bringup.plan import BringUp, Stage

PER_LINE = 8
OUTER = "outer_"  # begins the names of what is of the outer loop
HEADER = """/* The reference of {what}, made by seaopt: {phases} set(s) of phases, a period of
 * {period} ticks, at {rate} Hz, in {bytes} bytes of constants.
 * Call {call}_reference(tick) once per tick, from 0; it ends after {macro}_TICKS ticks, and is zero from there on. */
#ifndef {macro}_REFERENCE_H
#define {macro}_REFERENCE_H
#define {macro}_TICKS {ticks}UL
double {call}_reference(unsigned long tick); /* {unit} */
#endif
"""
SOURCE = """#include "{stem}.h"

#define PERIOD {period}UL
#define PERIODS {periods}UL
#define PHASES {phases}UL

static const float wave[PHASES][PERIOD] = {{
{waves}
}};

static double fade(unsigned long tick)
{{
    const double share = (double)tick / (double)PERIOD;
    return share * share * (3.0 - (2.0 * share));
}}

double {call}_reference(unsigned long tick)
{{
    const unsigned long played = PHASES * PERIODS * PERIOD;
    if (tick < PERIOD) return fade(tick) * (double)wave[0][tick];
    if (tick < PERIOD + played) return (double)wave[(tick - PERIOD) / (PERIODS * PERIOD)][tick % PERIOD];
    if (tick < {macro}_TICKS) return fade({macro}_TICKS - 1UL - tick) * (double)wave[PHASES - 1UL][tick % PERIOD];
    return 0.0;
}}
"""


def write_bring_up(
    plan: BringUp, folder: Path | str, *, tare: Tare | None = None, fit_met: bool | None = None
) -> tuple[Path, ...]:
    """Write a folder for each stage, and bringup.json beside them.

    Parameters
    ----------
    plan : BringUp
        Of `bring_up`.
    folder : path
        Made if it does not exist.
    tare : Tare, optional
        Beside each law the C that averages the zero of the force at rest.
    fit_met : bool, optional
        Whether the fit that the laws were tuned with is met (`fit.met`), which bringup.json, each controller.json and
        the C state; on one that is not, the bring-up is not met either.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    target = Path(folder)
    plan = plan if fit_met is None else replace(plan, fit_met=fit_met)
    files = [write_json(target / "bringup.json", plan.to_dict())]
    for stage in plan.stages:
        files += write_stage(stage, target / stage.name, tare=tare, fit_met=fit_met)
    return tuple(files)


def write_stage(
    stage: Stage, folder: Path | str, *, tare: Tare | None = None, fit_met: bool | None = None
) -> list[Path]:
    """Write the files of one stage into its own folder, as `write_bring_up` does; return them. `fit_met`: whether the
    fit that its law was tuned with is met, which controller.json and the C state.
    """
    folder = Path(folder)
    around = [] if stage.around is None else _write_played(stage.around, folder, "the outer loop", OUTER)
    return [
        *_export(stage, folder, tare, fit_met),
        write_json(folder / "controller.json", _describe(stage) | ({} if fit_met is None else {"fit_met": fit_met})),
        *_write_played(stage, folder, "a stage of bring-up"),
        *around,
    ]


def _write_played(expected: Expected, folder: Path, what: str, prefix: str = "") -> list[Path]:
    """Write a reference as a table and as C, and the bands of its response, with names that begin alike."""
    excitation, unit, stem = expected.excitation, expected.unit, f"{prefix}reference"
    reference, call = excitation.reference, prefix.rstrip("_") or "stage"
    time = excitation.sample_time_s * np.arange(reference.size)
    log = Log.from_arrays(time=time, reference=reference, units={"reference": unit}, source=stem)
    period, phases = excitation.period, excitation.phases
    waves = ",\n".join(f"{{\n{_list_numbers(excitation.bias + wave)}\n}}" for wave in excitation.list_waves())
    words = {"phases": phases, "period": period, "periods": excitation.periods, "ticks": reference.size, "unit": unit}
    words |= {"what": what, "call": call, "macro": call.upper(), "stem": stem}
    header = HEADER.format(**words, bytes=4 * period * phases, rate=f"{1.0 / excitation.sample_time_s:.10g}")
    return [
        write_log(log, folder / f"{stem}.csv"),
        write_text(folder / f"{stem}.h", header),
        write_text(folder / f"{stem}.c", SOURCE.format(**words, waves=waves)),
        write_text(folder / f"expected_{prefix}step.csv", _table("time [s]", expected.step)),
        write_text(folder / f"expected_{prefix}tracking.csv", _table("frequency [Hz]", expected.tracking)),
    ]


def _export(stage: Stage, folder: Path, tare: Tare | None, fit_met: bool | None) -> list[Path]:
    source = stage.source
    options: dict[str, Any] = {"log_rows": LOG_ROWS, "tare": tare, "stop": stage.stop}
    uncertified = "" if stage.met else "the certificate of the law of this stage FAILED"
    if isinstance(source, ForceMPC):
        texts = list_sources(collect_code(source), uncertified=uncertified)
        del texts["example.c"]  # the program is the stage's, or the user's: there is one main
        files = [write_text(folder / name, text) for name, text in texts.items()]
        return [*files, *export_beside(stage.controller, folder, **options)]
    options |= {"allow_infeasible": True, "fit_met": fit_met, "uncertified": uncertified}
    return [*export(source, folder, **options)]


def _describe(stage: Stage) -> dict[str, Any]:
    if isinstance(stage.source, ForceMPC):
        return stage.controller.to_dict() | {"mpc": describe_mpc(stage.source)}
    return stage.source.to_dict()


def _list_numbers(values: np.ndarray) -> str:
    texts = [f"{value:.8e}f" for value in values.tolist()]
    return ",\n".join(", ".join(texts[k : k + PER_LINE]) for k in range(0, len(texts), PER_LINE))


def _table(first: str, band: Band) -> str:
    rows = zip(band.at, band.nominal, band.low, band.high, strict=True)
    lines = [f"{first},nominal,low,high", *(",".join(f"{value:.7g}" for value in row) for row in rows)]
    return "\n".join(lines) + "\n"
