"""The C code of a `ForceMPC`: the numbers of one controller, and what runs it, which is the same for all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Constraints, Fields, to_content
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.compensation.ripple_term import COSINE, MOST_TURNS, SINE
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.mpc.active_set import DEPENDENT, DEPENDENT_SINGLE, TOLERANCE, TOLERANCE_SINGLE
from seaopt.control.mpc.mpc import VIOLATION, ForceMPC
from seaopt.control.mpc.output_bounds import SLACK_UNIT
from seaopt.control.mpc.quadratic_program import PENALTY, WIDE, factor_program, stack_hessian
from seaopt.control.mpc.step import find_rest_gain
from seaopt.files import plain, write_text
from seaopt.plants.motor.heat_guard import HeatGuard
from seaopt.records import record

CName = Annotated[str, Constraints(pattern=r"^[A-Za-z_]+$")]
CText = Annotated[str, Constraints(pattern=r'^[^"\\\r\n]*$')]  # stands between quotation marks in C
SOURCES = ("force_mpc.h", "force_mpc.c", "active_set.h", "active_set.c", "arithmetic.h", "example.c")


@record(eq=False)
class MPCCode:
    """All numbers of a controller's C code; `collect_code` takes them from one."""

    sizes: Mapping[CName, int]  # sizes, numbers, units, arrays: of ``force_mpc_data.h``
    numbers: Mapping[CName, float]
    units: Mapping[CName, CText]
    arrays: Mapping[CName, Float[np.ndarray, "..."]]
    hessian: Float[np.ndarray, "nv nv"]  # hessian, rows: of the program
    rows: Float[np.ndarray, "r nv"]
    heat: HeatGuard | None = None
    outer: OuterLoop | None = None
    terms: Annotated[Mapping[str, Any], Fields(of=Compensation)] | None = None
    link: LinkPath | None = None

    @property
    def compensation(self) -> Compensation | None:
        """What is compensated; None for nothing."""
        return None if self.terms is None else Compensation(sample_time_s=self.numbers["sample_time_s"], **self.terms)

    @property
    def parts(self) -> dict[str, str]:
        """The files of what stands around the plan, by name."""
        heat, outer, terms = self.heat, self.outer, self.compensation
        files = {
            "heat.h": heat and _format_heat(heat), "outer.h": outer and _format_outer(outer),
            "terms.h": _format_terms(terms, self.link, self.numbers),
        }  # fmt: skip
        return {name: text for name, text in files.items() if text}

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as they stand in controller.json."""
        return plain(to_content(self))


def export_mpc(mpc: ForceMPC, folder: Path | str, *, single_precision: bool = False) -> Path:
    """Write a controller as C99 that allocates nothing and needs no library; return the folder.

    ``force_mpc.h`` says how to compile and call it; ``example.c`` is a program around it. A step does what
    `ForceMPC.step` does, with the same checks and the same safe current.

    Parameters
    ----------
    mpc : ForceMPC
        As `force_mpc` makes it.
    folder : path
        Created if it does not exist; files of these names in it are overwritten.
    single_precision : bool
        float instead of double.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    return write_code(collect_code(mpc), folder, single_precision=single_precision)


def write_code(code: MPCCode, folder: Path | str, *, single_precision: bool = False, uncertified: str = "") -> Path:
    """Write a controller's C code, as `export_mpc`. `uncertified`: why it is not certified, for a comment."""
    target = Path(folder)
    for name, text in list_sources(code, single_precision=single_precision, uncertified=uncertified).items():
        write_text(target / name, text)
    return target


def list_sources(code: MPCCode, *, single_precision: bool = False, uncertified: str = "") -> dict[str, str]:
    """Return the files of a controller's C code by name."""
    folder = resources.files("seaopt.control.mpc").joinpath("c")
    texts = {name: folder.joinpath(name).read_text(encoding="utf-8") for name in SOURCES}
    return {**texts, "force_mpc_data.h": _format_data(code, single_precision, uncertified), **code.parts}


def collect_code(mpc: ForceMPC) -> MPCCode:
    """Return the numbers of a controller's C code."""
    kalman, prediction, spec, outputs = mpc.kalman, mpc.prediction, mpc.spec, mpc.prediction.outputs
    sizes = {
        "STATES": len(kalman.A), "PLANT_STATES": mpc.rest_state.size, "DELAY": kalman.delay_samples,
        "COMPUTE_DELAY_SAMPLES": mpc.compute_delay_samples,
        "KNOTS": prediction.knots.size, "ROWS": len(prediction.rows), "SLEWS": len(prediction.M),
        "SIGNALS": len(outputs.names), "SAMPLES": outputs.samples, "PREVIEW": spec.preview_samples,
        "HORIZON": spec.samples, "MAX_ITERATIONS": spec.max_iterations, "OUTER": int(mpc.outer is not None),
        "PREFILTER": 0 if spec.low_pass is None else spec.low_pass.den.size - 1,
    }  # fmt: skip
    numbers = {
        "limit": mpc.command_limit, "slew": spec.slew_per_sample, "static_gain": mpc.static_gain,
        "offset": float(kalman.offset[0]), "violation": VIOLATION, "penalty": PENALTY, "wide": WIDE,
        "slack_unit": SLACK_UNIT, "lag": prediction.lag_s / spec.sample_time_s,
    }  # fmt: skip
    arrays = {
        "A": kalman.A, "B": kalman.B[:, 0], "late": kalman.late[:, 0], "C": kalman.C[0],
        "gain": kalman.gain[:, 0], "rest": mpc.rest_state,
        "F": prediction.F, "M": prediction.M, "R": prediction.R, "shift": mpc.shift, "free": outputs.free,
        "forced": outputs.forced, "static": outputs.static, "centre": outputs.middle / outputs.half,
    }  # fmt: skip
    if spec.low_pass is not None:
        arrays |= {"prefilter_num": spec.low_pass.num, "prefilter_den": spec.low_pass.den}
    units = {
        "COMMAND": mpc.actuation.word,
        "COMMAND_UNIT": mpc.actuation.unit,
        "UNIT": mpc.design[0].outputs[mpc.measured],
        "DELAYS": mpc.delays,
    }
    terms, link = mpc.compensation, mpc.link
    if terms is not None or link is not None:
        placed = (terms.gravity, terms.ripple) if terms else ()
        read = {**mpc.design[0].outputs, **{term.reads: term.unit for term in placed if term}}
        read |= {link.measured: link.unit} if link else {}
        numbers |= {"per_effort": mpc.per_effort, "sample_time_s": spec.sample_time_s}
        units["READ"] = ", ".join(f"{name} in {read[name]}" if read.get(name) else name for name in mpc.reads)
    code = MPCCode(
        sizes=sizes,
        numbers={name: value for name, value in numbers.items() if np.isfinite(value)},
        units=units,
        arrays={name: value for name, value in arrays.items() if value.size},
        hessian=stack_hessian(prediction),
        rows=prediction.rows,
        outer=mpc.outer,
        terms=terms and {name: getattr(terms, name) for name in terms.json_keys},
        link=link,
    )
    return set_heat(set_gate(code, mpc.gate, spec.sample_time_s), mpc.heat)


def set_heat(code: MPCCode, heat: HeatGuard | None) -> MPCCode:
    """Return the numbers of a controller's C code with a heat guard in place of the one that they have."""
    return replace(code, sizes={**code.sizes, "HEAT": int(heat is not None)}, heat=heat)


def set_gate(code: MPCCode, gate: PlausibilityGate | None, sample_time_s: float) -> MPCCode:
    """Return the numbers of a controller's C code with a gate in place of the one that they have; None for none."""
    sizes = {**code.sizes, "GATE": int(gate is not None), "MAX_HELD": 0 if gate is None else gate.max_held}
    numbers = {name: value for name, value in code.numbers.items() if name not in ("low", "high", "step", "ramp")}
    if gate is not None:
        (numbers["low"], numbers["high"]), numbers["step"] = gate.range_N, gate.max_step_N
        numbers["ramp"] = gate.ramp_per_s * sample_time_s
    return replace(code, sizes=sizes, numbers=numbers)


def _format_data(code: MPCCode, single_precision: bool, uncertified: str) -> str:
    program = factor_program(code.hessian, code.rows)
    tolerance, dependent = (TOLERANCE_SINGLE, DEPENDENT_SINGLE) if single_precision else (TOLERANCE, DEPENDENT)
    numbers = {**code.numbers, "tolerance": tolerance, "dependent": dependent}
    arrays = {**code.arrays, "inverse": program.inverse, "normals": program.normals, "scale": program.scale}
    lines = [f"typedef {'float' if single_precision else 'double'} force_mpc_real;"]
    lines += [f"#define FORCE_MPC_{name} {value}" for name, value in {**code.sizes, **_place_terms(code)}.items()]
    lines += [f'#define FORCE_MPC_{name} "{text}"' for name, text in code.units.items()]
    lines += [f"static const force_mpc_real mpc_{name} = {_format_number(value)};" for name, value in numbers.items()]
    lines += [_format_array(name, value) for name, value in arrays.items()]
    return "\n".join(
        [
            "/* Sizes and numbers of one controller. */",
            *([f"/* NOT CERTIFIED: {uncertified} */"] if uncertified else []),
            "#ifndef FORCE_MPC_DATA_H",
            "#define FORCE_MPC_DATA_H",
            *lines,
            "#endif",
            "",
        ]
    )


def _format_heat(heat: HeatGuard) -> str:
    """Return the estimate of the winding's temperature as C: its numbers, in double, and the text that laws have."""
    names = {
        "RESISTANCE": heat.resistance, "RESISTANCE_SLOPE": heat.slope, "ALLOWED_RISE": heat.allowed_rise,
        "APPROACH": heat.share,
    }  # fmt: skip
    lines = [
        f"/* Rises in K above an ambient temperature of {heat.ambient:g} degC. */",
        f"static const double HEAT_A[2][2] = {{{{{heat.a_11!r}, {heat.a_12!r}}}, {{{heat.a_21!r}, {heat.a_22!r}}}}};",
        f"static const double HEAT_B[2] = {{{heat.b_1!r}, {heat.b_2!r}}};",
        *(f"static const double {name} = {value!r};" for name, value in names.items()),
    ]
    return "\n".join([*lines, "", _read_template("heat.c")])


def _format_outer(outer: OuterLoop) -> str:
    """Return the outer loop as C: its numbers, the direction in its gains."""
    numbers = {
        "OUTER_STIFFNESS": outer.direction * outer.stiffness, "OUTER_DAMPING": outer.direction * outer.damping,
        "OUTER_POLE": outer.pole, "OUTER_RATE": outer.rate,
    }  # fmt: skip
    return _format_part(outer.describe(), numbers, "outer.c")


def _format_terms(terms: Compensation | None, link: LinkPath | None, given: Mapping[str, float]) -> str:
    """Return what is added to a plan as C: the numbers of each term, and of what feeds the link back."""
    numbers, texts = dict[str, float | Sequence[float]](), list[str]()
    if terms is None and link is None:
        return ""
    if terms is not None and terms.gravity is not None:
        middle, scale, *series = terms.gravity.numbers
        numbers |= {"GRAVITY": series, "GRAVITY_MIDDLE": middle, "GRAVITY_SCALE": scale}
        texts.append("gravity.c")
    if terms is not None and terms.ripple is not None:
        cos, sin = zip(*terms.ripple.harmonics, strict=True)
        numbers |= {"RIPPLE_COS": cos, "RIPPLE_SIN": sin, "SINE": SINE, "COSINE": COSINE}
        numbers |= {"REVOLUTIONS": terms.ripple.numbers[0], "MOST_TURNS": MOST_TURNS, "QUARTER": 0.5 * math.pi}
        texts.append("ripple.c")
    if terms is not None and terms.friction is not None:
        share = terms.friction.share_per_step(terms.sample_time_s)
        numbers |= {"FRICTION_EFFORT": terms.friction.effort, "FRICTION_SHARE": share}
    part = _format_part("What is added", numbers, *texts)
    return part if link is None else part + _format_link(link.feedback(given["sample_time_s"]))


def _format_link(path: TransferFunction) -> str:
    """Return the numbers of what feeds the link back as C, in double, for its poles lie near 1."""
    ends = {"LINK_NUM": path.num, "LINK_DEN": path.den}
    lines = [f"static const double {name}[] = {{{', '.join(map(repr, ends[name].tolist()))}}};" for name in ends]
    return "\n".join([*lines, f"static const double LINK_REST = {find_rest_gain(path)!r};", ""])


def _place_terms(code: MPCCode) -> dict[str, int]:
    """Return which reading each term reads, from 1 on, and 0 for none; friction's from 2 on, 1 for the reference."""
    terms, link = code.compensation, code.link
    if terms is None and link is None:
        return {"TERMS": 0, "LINK": 0}
    linked = () if link is None else (link.measured,)
    reads = dict.fromkeys((*(terms.reads if terms else ()), *linked))
    placed: Mapping[str | None, int] = {None: 0, "": 0} | {name: 1 + i for i, name in enumerate(reads)}
    gravity, ripple, friction = (terms.gravity, terms.ripple, terms.friction) if terms else (None, None, None)
    return {
        "TERMS": 1,
        "READINGS": len(reads),
        "GRAVITY": placed[gravity and gravity.reads],
        "RIPPLE": placed[ripple and ripple.reads],
        "FRICTION": 0 if friction is None else 1 + placed[friction.reads],
        "LINK": placed[link and link.measured],
        "LINK_ORDER": 0 if link is None else link.feedback(code.numbers["sample_time_s"]).den.size - 1,
    }


def _format_part(said: str, numbers: Mapping[str, float | Sequence[float]], *texts: str) -> str:
    """Return what stands before the plan as C: what it is, its numbers, and the texts that laws have."""
    lines = [
        f"static const real {name}[] = {{{', '.join(map(_format_number, value))}}};"
        if isinstance(value, Sequence)
        else f"static const real {name} = {_format_number(value)};"
        for name, value in numbers.items()
    ]
    return "\n".join([f"/* {said}. */", *lines, "", *map(_read_template, texts)])


def _read_template(name: str) -> str:
    return resources.files("seaopt.control.deploy").joinpath("templates", name).read_text(encoding="utf-8")


def _format_number(value: float) -> str:
    return f"(force_mpc_real){value:.17g}"


def _format_array(name: str, value: Float[np.ndarray, "..."]) -> str:
    shape = "".join(f"[{n}]" for n in value.shape)
    if value.ndim == 1:
        body = ", ".join(map(_format_number, value))
    else:
        body = ",\n ".join("{" + ", ".join(map(_format_number, line)) + "}" for line in value)
    return f"static const force_mpc_real mpc_{name}{shape} = {{{body}}};"
