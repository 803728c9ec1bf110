"""Logs recorded under an exported law, judged: is it this law, and does the machine do what was certified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from seaopt.codec import to_content
from seaopt.control import Controller
from seaopt.errors import LogError, require_type
from seaopt.logs import Log
from seaopt.machine.replay import Replay, replay
from seaopt.machine.ticks import take_ticks
from seaopt.records import Result, Worded, record

ACCEPTANCE_SCHEMA = "seaopt/acceptance/1"


@record(eq=False, repr=False)
class Acceptance(Result, Worded):
    """What logs under a law say of it.

    Parameters
    ----------
    controller : Controller
        The law that is to have run.
    sources : tuple of str
        The logs.
    replays : tuple of Replay
        Of each log, how near the law comes to the logged command, and what else would come nearer.
    """

    controller: Controller
    sources: tuple[str, ...]
    replays: tuple[Replay, ...]

    @property
    def met(self) -> bool:
        """Whether every log was made by this law."""
        return all(row.met for row in self.replays)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of acceptance.json (schema seaopt/acceptance/1)."""
        logs = [{"log": source} | to_content(row) for source, row in zip(self.sources, self.replays, strict=True)]
        content = {
            "schema": ACCEPTANCE_SCHEMA,
            "met": self.met,
            "replay": {"met": all(row.met for row in self.replays), "logs": logs},
        }
        return to_content(content)


def accept(
    controller: Controller,
    logs: Sequence[Log],
    *,
    reference: str | None = None,
    others: Mapping[str, Controller] | None = None,
) -> Acceptance:
    """Judge logs that were recorded under a controller's exported law.

    Parameters
    ----------
    controller : Controller
        The law that is to have run.
    logs : sequence of Log
        Each with a row per tick of the law: its reference, what it read (`controller.signals`), and what it
        commanded, under the names of the plant's outputs and of the commanded input.
    reference : str, optional
        The reference's channel; "reference" or "ref" if left out.
    others : mapping of name to Controller, optional
        Laws that may have run in its place, such as those of earlier tunings.

    Returns
    -------
    Acceptance

    Raises
    ------
    LogError
        A channel is missing, or a log is too short.

    Examples
    --------
    >>> import numpy as np
    >>> import seaopt as so
    >>> spec = so.ControllerSpec(bandwidth_hz=30, current_limit_A=9.0)
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, spec)
    >>> reference = 100.0 * np.sign(np.sin(20.0 * np.arange(1000) * 1e-3))
    >>> force, effort = controller.close(stand, thor).simulate(reference)
    >>> log = so.Log.from_arrays(
    ...     time=1e-3 * np.arange(1000), reference=reference, F1=force, I=controller.per_effort * effort
    ... )
    >>> so.accept(controller, [log]).replays[0].met
    True
    """
    require_type(controller, Controller, "controller", "give what tune or assess returned", LogError)
    require_type(logs, Sequence, "logs", "give a list of logs", LogError)
    if not logs:
        raise LogError("logs is empty; give the logs that were recorded under the law")
    for log in logs:
        require_type(log, Log, "logs", "give logs of read_log or Log.from_arrays", LogError)
    rows = [take_ticks(controller, log, reference) for log in logs]
    return Acceptance(
        controller=controller,
        sources=tuple(log.source for log in logs),
        replays=tuple(replay(controller, ticks, others) for ticks in rows),
    )
