"""Predictive control of a problem file: `structure = "mpc"` in [controller], and its own keys in [mpc]."""

from __future__ import annotations

from seaopt.control import MPCSpec
from seaopt.errors import ProblemError
from seaopt.options import list_options
from seaopt.problem.option_tables import make_record, make_value
from seaopt.problem.references import RESPONSE
from seaopt.problem.schema import MPC, ControllerTable, MPCTable, ProblemTable

PLANNED = {field.name: field.kind for field in list_options(MPCSpec)}
SHARED = PLANNED.keys() & ControllerTable.model_fields.keys() - {"measured"}  # keys of [controller] that a plan has too


def make_mpc_spec(table: ProblemTable) -> MPCSpec | None:
    """Return what a file asks of predictive control; None where it asks for gains, or for no controller. Raises
    ProblemError: [mpc] is there without the structure, or a key is given that is of gains. Raises ControlError: a value
    is out of range.
    """
    controller = table.controller
    if controller is None or controller.structure != MPC:
        if table.mpc is not None:
            raise ProblemError('[mpc] is given, but [controller] is not predictive; write structure = "mpc" there')
        return None
    _check_keys(table, controller)
    assert isinstance(controller.measured, str)
    shared = {name: make_value(getattr(controller, name), PLANNED[name]) for name in SHARED}
    return make_record(MPCSpec, table.mpc or MPCTable(), measured=controller.measured, **shared)


def _check_keys(table: ProblemTable, controller: ControllerTable) -> None:
    taken = {"plant", "measured", "structure", "gate", "derate", "compensate", "link_feedforward", *SHARED}
    if all(name.startswith(RESPONSE) for name in controller.robust_to):  # which its linear region is certified on
        taken.add("robust_to")
    stated = sorted(controller.model_fields_set - taken)
    if stated:
        remedy = "name them in plants of [robustness]" if stated[0] == "robust_to" else "take it out"
        raise ProblemError(f'controller.{stated[0]} shapes gains, and structure = "mpc" has none; {remedy}')
    if not isinstance(controller.measured, str):
        raise ProblemError(
            f'controller.measured = {list(controller.measured)}: structure = "mpc" reads one output; write measured = '
            f'"{controller.measured[0]}"'
        )
    if table.robustness is not None and table.robustness.retune:
        raise ProblemError('robustness.retune tunes gains, and structure = "mpc" has none; take it out')
