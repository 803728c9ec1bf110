"""Several logs of the same channels as one, gaps between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.log.log import Log
from seaopt.logs.quality.clock import GAP
from seaopt.signals import Origin

SAME_RATE = 1e-3  # relative difference of periods that is one clock's


def concatenate(logs: Sequence[Log], *, gap_s: float | None = None) -> Log:
    """Append logs, each after the one before.

    Parameters
    ----------
    logs : sequence of Log
        With the same channels, in the same units, at the same rate.
    gap_s : float, optional
        Time from the last sample of one to the first of the next: more than 1.5 periods, so that a fit gives each its
        own initial state. Left out, the logs are on one clock already and keep their times.

    Raises
    ------
    LogError
        Channels, units or rates differ, times overlap, or gap_s is too short for a gap.

    Examples
    --------
    >>> log = Log.from_arrays(time=[0.0, 0.1, 0.2], F1=[1.0, 2.0, 3.0])
    >>> both = concatenate([log, log], gap_s=1.0)
    >>> both.time.round(9).tolist(), both.gaps
    ([0.0, 0.1, 0.2, 1.2, 1.3, 1.4], [(0.2, 1.2)])
    """
    if isinstance(logs, Log) or not logs:
        raise LogError("concatenate takes a list of logs; give at least one")
    first = logs[0]
    if gap_s is not None and not GAP * first.period < gap_s < np.inf:
        raise LogError(
            f"gap_s = {gap_s:g} is not a gap at {first.rate_hz:.6g} Hz; give more than {GAP * first.period:.4g} s"
        )
    for log in logs[1:]:
        _check_alike(first, log)
    times = [first.time]
    for log in logs[1:]:
        shift = 0.0 if gap_s is None else float(times[-1][-1]) + gap_s - float(log.time[0])
        times.append(log.time + shift)
        if times[-1][0] <= times[-2][-1]:
            raise LogError(
                f"{log.source}: starts at {times[-1][0]:g} s, before the log ahead of it ends at {times[-2][-1]:g} s; "
                "order the logs, or give gap_s"
            )
    sources = ", ".join(dict.fromkeys(log.source for log in logs))
    notes = [f"{log.source}: {note}" for log in logs for note in log.notes]
    signals = {
        name: replace(signal, values=np.concatenate([log[name] for log in logs]), origin=_merge_origins(name, logs))
        for name, signal in first.signals.items()
    }
    note = f"{len(logs)} logs appended"
    return Log(time=np.concatenate(times), signals=signals, source=sources, notes=(*dict.fromkeys(notes), note))


def _merge_origins(channel: str, logs: Sequence[Log]) -> Origin:
    """Return where an appended channel came from: what differs is listed, in the order of the logs."""
    origins = [asdict(log.signal(channel).origin) for log in logs]
    return Origin(**{name: "; ".join(dict.fromkeys(origin[name] for origin in origins)) for name in origins[0]})


def _check_alike(first: Log, log: Log) -> None:
    """Refuse a log that has other channels, units or another rate than the first."""
    for name in {**first.signals, **log.signals}:
        if name not in first.signals or name not in log.signals:
            where = log.source if name in log.signals else first.source
            raise LogError(f'channel "{name}" is in {where} alone; append logs with the same channels')
        units = first.signals[name].unit, log.signals[name].unit
        if units[0] != units[1]:
            raise LogError(f'{log.source}: channel {name} is in "{units[1]}" and was in "{units[0]}"; correct its unit')
    if abs(log.period / first.period - 1.0) > SAME_RATE:
        raise LogError(
            f"{log.source}: is sampled at {log.rate_hz:.6g} Hz and the first log at {first.rate_hz:.6g} Hz; "
            "resample or decimate one"
        )
