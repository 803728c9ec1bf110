"""What runs on the target beside a law: the log of its ticks (`seaopt.logs.formats.arrays` reads it), and the tare."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from seaopt.codec import to_content
from seaopt.control.deploy.c_text import identifier, strip_markup
from seaopt.control.laws.plausibility import FALSE_ALARMS, LARGEST, SIGMAS
from seaopt.control.laws.realisation import RunnableLaw
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule
from seaopt.errors import ControlError, require_number
from seaopt.files import digest_plain, plain
from seaopt.records import record
from seaopt.signals import REFERENCE, TARGET_LOG

LOG_TEMPLATES = {"{}_log.h": "log.h.jinja", "{}_log.c": "log.c.jinja"}
STAGE_TEMPLATES = {"{}_stage.h": "stage.h.jinja", "{}_stage.c": "stage.c.jinja"}
TARE_TEMPLATES = {"{}_tare.h": "tare.h.jinja", "{}_tare.c": "tare.c.jinja"}
LOG_ROWS, MOST_ROWS = 512, 1 << 20
WIDTH = 80  # of a piece of the header in C
FEWEST_TARED, MOST_TARED = 100, 1 << 30
DERIVED = {"anti_windup", "tracking_time_s", "heat"}  # computed again where a controller.json is read, to rounding


@record
class Tare:
    """How the zero of a force is averaged at rest.

    Parameters
    ----------
    noise : float
        Std of a reading, in its unit; the fit's, as a rule.
    limit : float
        The largest zero that is taken for one.
    duration_s : float
        Over which it is averaged.

    Raises
    ------
    ControlError
        A number is not positive, or beyond what a target's numbers hold.
    """

    noise: float
    limit: float
    duration_s: float = 1.0

    def __post_init__(self) -> None:
        for name in ("noise", "limit", "duration_s"):
            value = require_number(getattr(self, name), f"tare: {name}", ControlError)
            if not 1.0 / LARGEST < value < LARGEST:  # whose squares a target's `float` holds, too
                raise ControlError(
                    f"tare: {name} = {value:g} is not positive, between {1.0 / LARGEST:g} and {LARGEST:g}; give such a "
                    "number"
                )


def hash_law(law: RunnableLaw | RunnableSchedule, outer: OuterLoop | None = None) -> str:
    """Return what tells a law, with its limit, guards, terms and outer loop, from any other: 16 hexadecimal digits."""
    numbers = {field.name: getattr(law, field.name) for field in fields(law) if field.name not in DERIVED}
    if isinstance(law, RunnableSchedule):
        table = law.table
        numbers |= {"table": [table.structure, table.over, table.points, dict(table.columns)]}
    heat = () if law.heat is None else law.heat.numbers
    wound = np.ravel(law.anti_windup)
    scale = np.max(np.abs(wound), initial=0.0)
    shares = np.round(wound / (scale or 1.0), 9) + 0.0  # of the largest, for those that only rounding keeps from zero
    numbers |= {"heat": _round(heat), "anti_windup": [*_round([scale]), *shares.tolist()]}
    content = plain(to_content({**numbers, "outer": outer or law.outer}))
    return digest_plain(json.loads(json.dumps(content), parse_int=float))[:16]  # 9 and 9.0 are one limit


def _round(values: Iterable[float]) -> list[float]:
    """Return numbers that are computed again, to the digits in which they then agree."""
    return [float(f"{value:.9g}") for value in values]


def describe_log(
    context: Mapping[str, Any],
    law: RunnableLaw | RunnableSchedule,
    names: Sequence[str],
    rows: int,
    *,
    units: Mapping[str, str],
    digest: str,
) -> dict[str, Any]:
    """Return what the templates of a log have in words and numbers. `context`: of the law's; `names`: of what it reads,
    the regulated one first; `units`: of these, as far as they are known.
    """
    whole: Any = rows
    if isinstance(whole, bool) or not isinstance(whole, int) or not 2 <= rows <= MOST_ROWS or rows & (rows - 1):
        raise ControlError(f"log_rows = {rows!r} is not a power of two from 2 to {MOST_ROWS}; give such as {LOG_ROWS}")
    suffix, width = context["suffix"], 8 if context["precision"] == "double" else 4
    first, *more = names
    channels: list[tuple[str, str | None, str]] = [
        (REFERENCE, units[first], f"reference_{suffix}"),
        (first, units[first], f"measurement_{suffix}"),
        *((name, units.get(name), f"read_{identifier(name)}") for name in more),
    ]
    if isinstance(law, RunnableSchedule) and law.table.over not in names:
        channels.append((law.table.over, law.table.unit, f"at_{identifier(law.table.over)}"))
    channels.append((*law.command, context["symbol"]))
    header = {
        "law": context["name"],
        "hash": digest,
        "sample_time_s": law.sample_time_s,
        "real": f"float{8 * width}",
        "channels": [[name, unit] for name, unit, _ in channels],
    }
    text = f"{TARGET_LOG} {json.dumps(header)}\n"
    return {
        "channels": [
            {"shown": strip_markup(f"{name} ({unit or '-'})"), "symbol": symbol} for name, unit, symbol in channels
        ],
        "log_rows": rows,
        "row_bytes": 8 + width * len(channels),
        "header_bytes": len(text),
        "header_lines": [json.dumps(text[k : k + WIDTH]) for k in range(0, len(text), WIDTH)],
    }


def describe_stops(
    stop: Mapping[str, float], signals: Sequence[str], units: Mapping[str, str], suffix: str
) -> list[dict[str, str]]:
    """Return beyond what a stage stops by itself: of what is fed back, since where others have their zero is not known.
    `signals`: what is fed back, the regulated one first.
    """
    symbols = [f"measurement_{suffix}", *(f"read_{identifier(name)}" for name in signals[1:])]
    return [
        {
            "NAME": identifier(name).upper(),
            "symbol": symbol,
            "value": repr(float(stop[name])),
            "unit": strip_markup(units.get(name, "-")),
        }
        for name, symbol in zip(signals, symbols, strict=True)
        if name in stop
    ]


def describe_unwatched(stop: Mapping[str, float], signals: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """Return the signals that have a figure to stop beyond and that a stage does not watch, each with that figure."""
    return [
        strip_markup(f"{name}: stop it yourself beyond {float(value):.4g} {units.get(name, '')}".rstrip())
        for name, value in stop.items()
        if name not in signals
    ]


def describe_tare(tare: Tare, sample_time_s: float) -> dict[str, Any]:
    """Return the numbers of a tare as text. Raises ControlError: it is too short or too long."""
    count = 2 * round(0.5 * tare.duration_s / sample_time_s)
    if count < FEWEST_TARED:
        raise ControlError(
            f"tare: duration_s = {tare.duration_s:g} is {count} samples; average {FEWEST_TARED} at least"
        )
    if count > MOST_TARED:
        raise ControlError(
            f"tare: duration_s = {tare.duration_s:g} is {count:g} samples; give {MOST_TARED * sample_time_s:g} at most"
        )
    of_mean = SIGMAS * tare.noise / math.sqrt(count)
    slack = 2.0 / (9.0 * (count - 1))  # the end of chi squared, by Wilson and Hilferty
    variance = tare.noise**2 * (1.0 - slack + SIGMAS * math.sqrt(slack)) ** 3
    return {
        "samples": count,
        "seconds": f"{count * sample_time_s:g}",
        "noise": repr(float(tare.noise)),
        "limit": repr(float(tare.limit)),
        "jump": repr(math.sqrt(2.0) * SIGMAS * tare.noise),
        "apart": repr(2.0 * of_mean),
        "variance": repr(variance),
        "noise_of_bound": repr(3.0 * of_mean),
        "bound": repr(5.0 * of_mean),
        "refused": f"{1.0 / (count * FALSE_ALARMS):.1g}",
    }
