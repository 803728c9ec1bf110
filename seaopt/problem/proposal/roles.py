"""Which column of a log is which signal of an actuator, guessed from headers and samples, for a new problem file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from seaopt.errors import LogError
from seaopt.formatting import join_words
from seaopt.logs.reading.vocabulary import UNITS_OF, Quantity
from seaopt.problem.proposal.survey import LogSurvey, SurveyedColumn, find_leader, regress, share_of_jerk
from seaopt.records import record
from seaopt.units import header_unit

INPUTS = ("I", "torque", "V", "duty", "goal")  # what may drive a motor; of each kind of command its own plant
LINEAR_OUTPUTS = ("F1", "F2", "q", "screw", "phi")  # screw: the motor's angle, which is q over the lead
ROTARY_OUTPUTS = ("tau_s", "theta_m", "theta_l", "deflection")
OF_INPUT: dict[str, Quantity] = {"I": "current", "torque": "torque", "V": "voltage", "duty": "duty", "goal": "angle"}
OF_OUTPUT: dict[str, Quantity] = {
    "F1": "force", "F2": "force", "q": "length", "screw": "angle", "phi": "angle",
    "tau_s": "torque", "theta_m": "angle", "theta_l": "angle", "deflection": "angle",
}  # fmt: skip
DESCRIPTIONS = {
    "I": "motor current", "torque": "commanded torque", "V": "motor voltage", "duty": "duty of the bridge",
    "goal": "goal of a position loop", "F1": "force at the spring", "F2": "force at the nut", "q": "place of the nut",
    "screw": "angle of the motor", "phi": "angle of the link",
    "tau_s": "torque at the spring", "theta_m": "angle of the motor", "theta_l": "angle of the link",
    "deflection": "deflection of the spring",
}  # fmt: skip
FOLLOWS = 0.9  # share of variance from which two channels are one but for a factor
BY_SIZE, BY_DEFAULT = "by the size of its numbers", "the usual one"  # why a unit is guessed
TURN, MOVES = 6.5, 0.5  # of an angle without a unit: more than a turn in radians, unless it moves less
GEARED_APART = 2.0  # swings of motor and link between which no gear tells them apart
RESPONDS = 0.02  # share of an angle's jerk that the input explains at once: of a motor, not behind a spring
SURELY = 3.0  # times the other's share
STILL = 0.02  # of the motor's motion: a link that moves less is held
SUPPLIED = 0.5  # of its largest value: a voltage that never falls below is a supply's


@record(eq=False)
class Assignment:
    """Roles of a log's columns."""

    rotary: bool  # a gear's actuator, else a screw's
    input: str  # one of `INPUTS`
    columns: Mapping[str, SurveyedColumn]  # the input's and the outputs'
    unused: Mapping[str, str]  # why other columns are not used
    doubts: Mapping[str, str]  # what of it is a guess, in a sentence

    @property
    def outputs(self) -> tuple[str, ...]:
        """The roles of what is measured."""
        return tuple(role for role in self.columns if role != self.input)


def is_rotary(columns: Sequence[SurveyedColumn]) -> tuple[bool, str]:
    """Return whether an actuator turns, and why that is a guess; "" where its columns leave no doubt."""
    kinds = {column.header.quantity for column in columns}
    linear, turning = kinds & {"force", "length"}, kinds & {"torque"}
    if linear and not turning:
        return False, "" if "force" in kinds else "a column is a length, and none a torque"
    if turning:
        return True, "a column is a torque, and another a force or a length" if linear else ""
    return True, "a column is an angle" if "angle" in kinds else "the usual one; no column tells"


def assign(survey: LogSurvey, *, rotary: bool, given: Mapping[str, str]) -> Assignment:
    """Return the roles of a log's columns; `given` are those that are known, column to role ("" for none)."""
    free = [
        column
        for column in survey.columns
        if column.name not in given and column.header.quantity not in ("other", "time")
    ]
    columns = {given[column.name]: column for column in survey.columns if given.get(column.name)}
    doubts: dict[str, str] = {}
    role = next((role for role in columns if role in INPUTS), None)
    if role is None:
        role, column, doubt = _find_input(free, survey)
        columns = {role: column, **columns}
        free.remove(column)
        doubts |= {column.name: doubt} if doubt else {}
    else:
        columns = {role: columns.pop(role), **columns}
    # Of two columns of one role, the measured one, and then the first, is taken.
    free.sort(key=lambda column: (column.header.commanded, not column.header.measured))
    assign = _place_rotary if rotary else _place_linear
    doubts |= assign([column for column in free if not column.header.commanded], columns)
    used = {column.name for column in columns.values()}
    return Assignment(
        rotary=rotary,
        input=role,
        columns=columns,
        doubts=doubts,
        unused={
            column.name: "as answered"
            if column.name in given
            else _explain_unused(column, role, columns, rotary=rotary)
            for column in survey.columns
            if column.name not in used
        },
    )


def _explain_unused(column: SurveyedColumn, source: str, roles: Mapping[str, SurveyedColumn], *, rotary: bool) -> str:
    """Return why a column has no role; `source` is the input's."""
    header = column.header
    if _is_supply(column):
        return "a supply, which never comes near zero"
    if header.quantity in ("", "other", "time"):
        return "not a signal of the actuator" if header.quantity else "its name does not say what it is"
    if header.quantity == "speed":
        return "a speed, which a fit takes from a position"
    if header.commanded or header.quantity in ("current", "voltage", "duty"):
        return f"the input is {roles[source].name}"
    motor, links = (("theta_m",), ("theta_l",)) if rotary else (("q", "screw"), ("phi",))
    of_side = {"motor": motor, "link": links}.get(header.side, motor + links)
    signals = {"torque": ("tau_s",)} if rotary else {"force": ("F1", "F2"), "length": motor * (header.side != "link")}
    places = ("deflection",) if rotary and header.deflection else of_side
    taken = [roles[role].name for role in (signals | {"angle": places}).get(header.quantity, ()) if role in roles]
    if taken:
        return f"{join_words(taken)} {'is' if len(taken) == 1 else 'are'} that already"
    if not rotary and header.quantity == "length":
        return 'the place of a load that slides, which no plant here has; kind = "two_link" has it as x_2'
    return f"no output of an actuator with a {'gear' if rotary else 'screw'}"


def _is_supply(column: SurveyedColumn) -> bool:
    """Tell whether a voltage is that of a supply: one that drives a motor both ways goes through zero."""
    if column.header.quantity != "voltage" or column.header.commanded:
        return False
    values = column.values[np.isfinite(column.values)]
    least, largest = np.sort(np.abs(np.quantile(values, [0.01, 0.99])))
    return bool(np.all(values > 0.0) or np.all(values < 0.0)) and bool(least > SUPPLIED * largest)


def _find_input(columns: Sequence[SurveyedColumn], survey: LogSurvey) -> tuple[str, SurveyedColumn, str]:
    """Return the input's role, column, and why that is a guess, or "". Raises LogError: no column drives a motor."""
    for role, quantity in OF_INPUT.items():
        named = [column for column in columns if column.header.quantity == quantity and not _is_supply(column)]
        if role in ("torque", "goal"):  # which are measured as often
            named = [column for column in named if column.header.commanded]
        if role == "goal":
            named += [column for column in columns if column.header.commanded and not column.header.quantity]
        if not named:
            continue
        # A current that was commanded is there before the one that was measured.
        best = min(named, key=lambda column: (not column.header.commanded, column.header.side == "link"))
        passed_over = [column.name for column in named if column is not best]
        return role, best, f"the input, and not {', '.join(passed_over)}" if passed_over else ""
    likely = [column for column in columns if not column.header.quantity]
    likely = likely or [column for column in columns if column.header.quantity in ("torque", "angle")]
    if not likely:
        names = join_words([column.name for column in survey.columns])
        raise LogError(
            f"{survey.name}: no column drives a motor, of {names}; name it (--channel I=COLUMN), or log its current as "
            "well, or the torque, voltage, duty or goal that it is sent"
        )
    leader = find_leader(likely)
    role = "torque" if leader.header.quantity == "torque" else "goal" if leader.header.quantity == "angle" else "I"
    return role, leader, "the input, as the other columns follow it"


def _place_rotary(columns: list[SurveyedColumn], roles: dict[str, SurveyedColumn]) -> dict[str, str]:
    """Give a rotary actuator's columns their roles; return what is a guess."""
    doubts: dict[str, str] = {}
    torques = [column for column in columns if column.header.quantity == "torque"]
    if torques and "tau_s" not in roles:
        # A drive's own torque is its current times a constant; the sensor's is the spring's.
        order = {"spring": 0, "link": 1, "": 2, "motor": 3}
        best = min(torques, key=lambda column: order[column.header.side])
        roles["tau_s"] = best
        if len(torques) > 1 and best.header.side != "spring":
            doubts[best.name] = f"the torque at the spring, of {len(torques)} torques"
    angles = [column for column in columns if column.header.quantity == "angle"]
    for column in angles:
        side = (
            "deflection"
            if column.header.deflection
            else {"motor": "theta_m", "link": "theta_l"}.get(column.header.side)
        )
        if side is not None:
            roles.setdefault(side, column)
    named = {id(column) for column in roles.values()}
    open_angles = sorted(
        (
            column
            for column in angles
            if id(column) not in named and not column.header.deflection and not column.header.side
        ),
        key=lambda column: -column.swing,
    )
    if len(open_angles) > 1 and open_angles[0].swing < GEARED_APART * open_angles[1].swing:
        driver = next(iter(roles.values()))
        shares = {column.name: share_of_jerk(column, driver) for column in open_angles[:2]}
        if max(shares.values()) > max(RESPONDS, SURELY * min(shares.values())):
            open_angles[:2] = sorted(open_angles[:2], key=lambda column: -shares[column.name])
    for column, role in zip(open_angles, [r for r in ("theta_m", "theta_l") if r not in roles], strict=False):
        roles[role] = column
        doubts[column.name] = f"the {DESCRIPTIONS[role]}, as its header does not say which angle"
    return doubts | _place_unnamed(columns, roles, ("tau_s", "theta_m", "theta_l"))


def _place_linear(columns: list[SurveyedColumn], roles: dict[str, SurveyedColumn]) -> dict[str, str]:
    """Give a screw's columns their roles; return what is a guess."""
    doubts: dict[str, str] = {}
    forces = [column for column in columns if column.header.quantity == "force"]
    for column in forces:
        if column.header.number is not None:
            roles.setdefault(f"F{column.header.number}", column)
    for column in forces:
        left = [role for role in ("F1", "F2") if role not in roles]
        if column not in roles.values() and left:
            roles[left[0]] = column
            doubts[column.name] = f"the {DESCRIPTIONS[left[0]]}, {left[0]}, as its header has no number"
    for column in columns:
        if column.header.quantity == "length" and column.header.side != "link" and "screw" not in roles:
            roles.setdefault("q", column)
    for column in columns:
        if column.header.quantity == "angle" and column.header.side == "link":
            roles.setdefault("phi", column)
        elif column.header.quantity == "angle" and "q" not in roles:  # the nut's place needs no lead and no counts
            roles.setdefault("screw", column)
    return doubts | _place_unnamed(columns, roles, ("F1", "F2"))


def _place_unnamed(
    columns: list[SurveyedColumn], roles: dict[str, SurveyedColumn], wanted: Sequence[str]
) -> dict[str, str]:
    """Take columns whose headers say nothing as what is measured, where nothing else is."""
    if len(roles) > 1:
        return {}
    blank = [column for column in columns if not column.header.quantity and column not in roles.values()]
    for role, column in zip(wanted, blank, strict=False):
        roles[role] = column
    return {
        column.name: f"the {DESCRIPTIONS[role]}, as nothing else is measured"
        for role, column in zip(wanted, blank, strict=False)
    }


def guess_unit(role: str, column: SurveyedColumn) -> tuple[str, str]:
    """Return a column's unit, and why that is a guess; "" where its header says so."""
    unit, why = _guess_unit(role, column)
    stated = header_unit(column.name)
    return unit, f'"{stated}" is not a known unit; {why}' if why and stated and not column.header.unit else why


def _guess_unit(role: str, column: SurveyedColumn) -> tuple[str, str]:
    unit, quantity = column.header.unit, OF_INPUT.get(role) or OF_OUTPUT[role]
    if unit and not (role == "duty" and unit != "percent"):
        return unit, ""
    large = column.largest
    if quantity == "current":
        return "mA" if large > 100.0 else "A", BY_SIZE
    if quantity == "duty":
        return "percent" if 1.5 < large <= 100.0 else "-", BY_SIZE
    if quantity == "angle":
        if column.whole and large > 50.0:
            return "counts", "all its numbers are whole"
        if role in ("theta_m", "screw", "goal"):  # a motor turns many times, in radians as in degrees
            return "rad", BY_DEFAULT
        return "deg" if large > TURN and column.swing > MOVES else "rad", BY_SIZE
    if quantity == "length":
        return "mm" if large > 0.5 else "m", BY_SIZE
    return UNITS_OF[quantity], BY_DEFAULT


def is_held(assignment: Assignment, link_unit: float, motor_unit: float) -> tuple[bool, str]:
    """Return whether a gear's link is held, and what suggests so; units are in rad per unit of the column."""
    columns = assignment.columns
    motor, link, torque = (columns.get(role) for role in ("theta_m", "theta_l", "tau_s"))
    if link is not None:
        still = motor is not None and link.swing * link_unit < STILL * motor.swing * motor_unit / 100.0
        return still, f"{link.name} {'stands still' if still else 'moves'}"
    if motor is not None and torque is not None:
        _, share = regress(torque.values, motor.values)
        return share > FOLLOWS, f"{torque.name} {'follows' if share > FOLLOWS else 'does not follow'} {motor.name}"
    if torque is not None:
        return True, "the link was not measured"
    return False, "no torque was measured"
