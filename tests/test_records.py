"""Records against the standard library's dataclasses, which say what comparing and printing them means."""

from dataclasses import FrozenInstanceError, dataclass, field

import pytest

from seaopt.records import record


class Coordinates:
    """Two numbers and a note, which does not tell places apart."""

    x: float
    y: float = 2.0
    note: str = field(default="", compare=False)


class One:
    """A single field."""

    inner: object


PAIRS = [
    (record(type(each.__name__, (), dict(each.__dict__))), dataclass(frozen=True, slots=True, kw_only=True)(each))
    for each in (Coordinates, One)
]


def test_records_are_equal_where_dataclasses_are() -> None:
    (place, standard), (one, _) = PAIRS
    values = ({"x": 1.0}, {"x": 1.0, "note": "a"}, {"x": 2.0}, {"x": 1.0, "y": 3.0})
    ours, theirs = [place(**each) for each in values], [standard(**each) for each in values]
    assert [[a == b for a in ours] for b in ours] == [[a == b for a in theirs] for b in theirs]
    assert len(set(ours)) == len(set(theirs)) == 3
    assert place(x=1.0) != one(inner=1.0) != 1.0
    assert one(inner=1.0) == one(inner=1.0)


def test_records_print_themselves_as_dataclasses_do() -> None:
    (place, standard), (one, other) = PAIRS
    assert repr(one(inner=place(x=1.0))) == repr(other(inner=standard(x=1.0)))
    endless: list[object] = []
    endless.append(one(inner=endless))
    assert "..." in repr(endless[0])


def test_records_do_not_change_and_are_told_apart_by_identity_where_asked() -> None:
    (place, _), _ = PAIRS
    with pytest.raises(FrozenInstanceError):
        place(x=1.0).x = 2.0

    @record(eq=False)
    class Unlike:
        """Of arrays."""

        x: float

    assert Unlike(x=1.0) != Unlike(x=1.0)
