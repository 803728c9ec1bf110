"""Predictive control of a problem file: `structure = "mpc"` in [controller], and what only it has in [mpc]."""

from __future__ import annotations

from seaopt.control import MPCSpec
from seaopt.errors import ProblemError
from seaopt.options import list_options
from seaopt.problem.option_tables import make_record
from seaopt.problem.schema import MPC, ControllerTable, MPCTable, ProblemTable

PLANNED = {one.name for one in list_options(MPCSpec)}
SHARED = PLANNED & ControllerTable.model_fields.keys() - {"measured"}  # keys of [controller] that a plan has too


def make_mpc_spec(table: ProblemTable) -> MPCSpec | None:
    """Return what a file asks of predictive control; None where it asks for gains, or for no controller.

    Raises ProblemError: [mpc] is there without the structure, or a key is given that is of gains. Raises ControlError:
    a value is out of range.
    """
    controller = table.controller
    if controller is None or controller.structure != MPC:
        if table.mpc is not None:
            raise ProblemError('[mpc] is there, and [controller] asks for no plan; write structure = "mpc" there')
        return None
    _check_keys(table, controller)
    assert isinstance(controller.measured, str)
    shared = {name: getattr(controller, name) for name in SHARED}
    return make_record(MPCSpec, table.mpc or MPCTable(), measured=controller.measured, **shared)


def _check_keys(table: ProblemTable, controller: ControllerTable) -> None:
    given = sorted(controller.model_fields_set - {"plant", "measured", "structure", "gate", *SHARED})
    if given:
        raise ProblemError(f'controller.{given[0]} is of gains, and structure = "mpc" plans; take it out')
    if not isinstance(controller.measured, str):
        raise ProblemError(
            f'controller.measured = {list(controller.measured)}: structure = "mpc" reads one output; write measured = '
            f'"{controller.measured[0]}"'
        )
    if table.impedance is not None:
        raise ProblemError('[impedance] closes its loop around gains, and structure = "mpc" plans; take it out')
    if table.robustness is not None and table.robustness.retune:
        raise ProblemError('robustness.retune is of gains, and structure = "mpc" plans; take it out')
