"""Predictive control of a problem file: `structure = "mpc"` in [controller], and what only it has in [mpc]."""

from __future__ import annotations

from typing import Any

from seaopt.control import MPCSpec, NoiseModel
from seaopt.control.laws.delay import DELAY_KEYS
from seaopt.errors import ProblemError
from seaopt.problem.schema import MPC, ControllerTable, MPCTable, ProblemTable

SHARED = (  # keys of [controller] that a plan has too
    "bandwidth_hz", "sample_rate_hz", *DELAY_KEYS, "current_limit_A", "command_limit", "max_sensitivity",
    "max_complementary", "min_disk_margin", "max_reference_peak", "max_droop_db", "max_noise_gain",
    "min_sensitivity_bandwidth_hz",
)  # fmt: skip


def make_mpc_spec(table: ProblemTable) -> MPCSpec | None:
    """Return what a file asks of predictive control; None where it asks for gains, or for no controller.

    Raises
    ------
    ProblemError
        [mpc] is there without the structure, or a key is given that is of gains.
    ControlError
        A value is out of range.

    """
    asked = table.controller
    if asked is None or asked.structure != MPC:
        if table.mpc is not None:
            raise ProblemError('[mpc] is there, and [controller] asks for no plan; write structure = "mpc" there')
        return None
    _check_keys(table, asked)
    assert isinstance(asked.measured, str)
    own = table.mpc or MPCTable()
    noise = None if own.noise is None else NoiseModel(**own.noise.model_dump())
    fields: dict[str, Any] = {name: getattr(asked, name) for name in SHARED} | own.model_dump(exclude={"noise"})
    return MPCSpec(**fields, measured=asked.measured, noise=noise)


def _check_keys(table: ProblemTable, asked: ControllerTable) -> None:
    given = sorted(asked.model_fields_set - {"plant", "measured", "structure", "gate", *SHARED})
    if given:
        raise ProblemError(f'controller.{given[0]} is of gains, and structure = "mpc" plans; take it out')
    if not isinstance(asked.measured, str):
        raise ProblemError(
            f'controller.measured = {list(asked.measured)}: structure = "mpc" reads one output; write measured = '
            f'"{asked.measured[0]}"'
        )
    if table.impedance is not None:
        raise ProblemError('[impedance] closes its loop around gains, and structure = "mpc" plans; take it out')
    if table.robustness is not None and table.robustness.retune:
        raise ProblemError('robustness.retune is of gains, and structure = "mpc" plans; take it out')
