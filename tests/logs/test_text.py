"""Text files as instruments write them: the same three samples in every dress."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.errors import LogError, UnitError
from seaopt.logs import Column, contents, read_log, read_table
from seaopt.logs.formats.text_layout import _join_quoted_lines, _number_header
from seaopt.logs.reading.column import spell_column, suspect_wrap
from seaopt.logs.reading.selection import is_time_name

TIME, CURRENT, FORCE = [0.0, 0.0025, 0.005], [0.1, -0.15, 0.2], [10.5, 20.25, -3e-3]
ROWS = "0;100;10,5\n2,5;-150;20,25\n5;200;-3e-3\n"
POINT = ROWS.replace(",", ".")
DRESSES = {
    "comma": "t [ms],I [mA],F [N]\n" + POINT.replace(";", ","),
    "semicolon": "t [ms];I [mA];F [N]\n" + POINT,
    "decimal comma": "t [ms];I [mA];F [N]\n" + ROWS,
    "tab": "t [ms]\tI [mA]\tF [N]\n" + POINT.replace(";", "\t"),
    "decimal comma and tab": "t [ms]\tI [mA]\tF [N]\n" + ROWS.replace(";", "\t"),
    "pipe": "t [ms]|I [mA]|F [N]\n" + POINT.replace(";", "|"),
    "blanks": "t [ms]   I [mA]  F [N]\n" + POINT.replace(";", "   "),
    "aligned columns": "  t [ms]   I [mA]  F [N]\n"
    + "".join(f"   {row}\n" for row in POINT.replace(";", "  ").splitlines()),
    "cells with blanks": "t [ms], I [mA], F [N] \n" + POINT.replace(";", " , ").replace("\n", " \n"),
    "quoted": '"t [ms]","I [mA]","F [N]"\n"0","100","10.5"\n"2.5","-150","20.25"\n"5","200","-3e-3"\n',
    "units row": "t;I;F\nms;mA;N\n" + POINT,
    "units row in brackets": "t;I;F\n[ms];[mA];[N]\n" + POINT,
    "comments": "# bench 3\n# 2026-01-15\nt [ms];I [mA];F [N]\n" + POINT,
    "header in a comment": "% t [ms];I [mA];F [N]\n" + POINT,
    "banner": "Scope 3000, serial 17\nRate;400\n\nt [ms];I [mA];F [N]\n" + POINT,
    "banner as wide as the data": "Scope 3000;;\nt [ms];I [mA];F [N]\n" + POINT,
    "trailing delimiter": "t [ms];I [mA];F [N];\n" + POINT.replace("\n", ";\n"),
    "trailing delimiter in rows": "t [ms];I [mA];F [N]\n" + POINT.replace("\n", ";\n"),
    "CRLF": ("t [ms];I [mA];F [N]\n" + POINT).replace("\n", "\r\n"),
    "blank lines": ("t [ms];I [mA];F [N]\n" + POINT).replace("\n", "\n\n"),
    "end of file mark": "t [ms];I [mA];F [N]\n" + POINT + "\n\x1a",
    "no end of line": ("t [ms];I [mA];F [N]\n" + POINT).rstrip("\n"),
}


@pytest.fixture
def file(tmp_path):
    def write(content, name="log.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def check(log):
    np.testing.assert_allclose(log.time, TIME, atol=1e-15)
    np.testing.assert_allclose(log.signals["I"].values, CURRENT)
    np.testing.assert_allclose(log.signals["F"].values, FORCE)
    assert [log.signals[name].unit for name in ("I", "F")] == ["A", "N"]


@pytest.mark.parametrize("dress", DRESSES)
def test_layouts(file, dress):
    check(read_table(file(DRESSES[dress])))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings(file, encoding):
    mark = {"utf-16-le": b"\xff\xfe", "utf-16-be": b"\xfe\xff"}.get(encoding, b"")
    check(read_table(file(mark + DRESSES["decimal comma"].encode(encoding))))


def test_a_header_in_windows_1252_is_read_and_said(file):
    """As a spreadsheet saves it in Germany: µ and ° are single bytes there."""
    text = "t [ms];Strom [µA];Kraft [N] µ;Winkel [°]\n0;1,5;10;90\n1;2,5;20;180\n2;3,5;30;270\n"
    table = read_table(file(text.encode("cp1252")))
    np.testing.assert_allclose(table.signals["Strom"].values, [1.5e-6, 2.5e-6, 3.5e-6])
    np.testing.assert_allclose(table.signals["Winkel"].values, np.radians([90, 180, 270]))
    (force,) = [name for name in table.signals if name.startswith("Kraft")]
    np.testing.assert_allclose(table.signals[force].values, [10, 20, 30])
    assert any("Windows-1252: ° µ" in note for note in table.notes)


def test_bytes_that_are_no_utf_8_among_the_data_are_refused_with_what_converts_them(file):
    with pytest.raises(LogError, match=r"iconv -f WINDOWS-1252 -t UTF-8"):
        read_table(file("t;I;F;note\n0;1;2;Pr\xfcfung\n1;1;2;x\n".encode("latin-1")))


def test_two_header_lines_are_joined_and_said(file):
    table = read_table(file("motor;;load\nt [ms];I [mA];F [N]\n" + POINT), time="motor t [ms]")
    assert list(table.signals) == ["I", "load F"]
    assert "2 header lines were joined" in table.notes


def test_a_file_without_header_has_numbered_columns(file):
    table = read_table(file(POINT), time=Column(column="column 1", unit="ms"))
    np.testing.assert_allclose(table.signals["column 3"].values, FORCE)


def test_brackets_that_are_no_units_are_names(file):
    table = read_table(file("Time[usec],CH1(msr),CH2(pos_t)\n0,1,2\n40,1,2\n80,2,2\n"))
    assert list(table.signals) == ["CH1(msr)", "CH2(pos_t)"]
    assert all(signal.unit == "" for signal in table.signals.values())
    np.testing.assert_allclose(table.time, [0, 40e-6, 80e-6])


def test_provenance_names_file_hash_column_and_conversion(file):
    import hashlib

    path = file(DRESSES["comma"])
    origin = read_log(path).signals["I"].origin
    assert (origin.file, origin.column, origin.conversion) == (str(path), "I [mA]", "mA to A")
    assert origin.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_table_keeps_what_a_log_refuses(file):
    path = file("t [s],F [N]\n0,1\n2,2\n1,3\n1,4\n")
    np.testing.assert_array_equal(read_table(path).time, [0, 2, 1, 1])
    with pytest.raises(LogError, match="runs backwards at sample 3"):
        read_log(path)


def test_what_is_odd_is_noted(file):
    table = read_table(file("t [s],F [N],I [A],n\n0,,1,x\n1,,1,y\n"))
    assert set(table.notes) >= {
        "columns that hold no numbers were left out: n",
        "F: holds no number",
        "I: is constant at 1 A",
    }


def test_blocks_meet_without_seam(file, monkeypatch):
    import seaopt.logs.formats.text as text

    monkeypatch.setattr(text, "CHUNK_BYTES", 100)
    values = np.random.default_rng(0).normal(size=(500, 2))
    lines = [f"{i / 1000:.3f},{a!r},{b!r}" for i, (a, b) in enumerate(values.tolist())]
    table = read_table(file("t [s],a,b\n" + "\n".join(lines) + "\n"))
    np.testing.assert_array_equal(np.column_stack([table.signals[n].values for n in "ab"]), values)
    np.testing.assert_allclose(table.time, np.arange(500) / 1000)
    lines[400] = "0.400,1.0,oops"
    with pytest.raises(LogError, match='line 402: "oops" in column "b"'):
        read_table(file("t [s],a,b\n" + "\n".join(lines) + "\n"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("\n \n", "the file is empty"),
        ("# only a comment\n", "only comments"),
        ("t [s],F [N]\n", "0 rows below the header"),
        ("t [s],F [N]\n0,1\n1,1.2.3\n", 'line 3: "1.2.3" in column "F \\[N\\]" is not a number'),
        ("t [s],F [N]\n0,1\n1,inf\n", 'line 3: "inf" in column "F \\[N\\]" is not finite'),
        ("t [s],F [N]\n0,1\n1,2,3\n", "line 3 has 3 columns and the header 2"),
        ("t,F\n0,1\n1,2\n", 'column "t" has no unit'),
        ("t [N],F [N]\n0,1\n1,2\n", "not a unit of time"),
        ("x [s],F [N]\n0,1\n1,2\n", "no column is named like a time"),
        ("t [s],time [s]\n0,1\n1,2\n", "2 columns are named like a time"),
        ("t [s],F [N]\n0,1\n", "too few samples"),
        ("t [s],F [N]\n0," + "1" * (2 << 20) + "\n1,2\n", "line 2 is longer than 1 MiB"),
        ("t [s];F [N]\n0,1,5\n1,2,5\n", "cannot be read as CSV"),
        ("a\rb\r1\r2", "CR alone"),
    ],
)
def test_bad_text_says_where(file, text, words):
    with pytest.raises((LogError, UnitError), match=words) as raised:
        read_table(file(text))
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


def test_units_are_checked_with_their_column(file):
    path = file("t [s],F [foo]\n0,1\n1,2\n")
    with pytest.raises(UnitError, match='column "F \\[foo\\]": unit "foo" is not known'):
        read_table(path, channels={"F": "F [foo]"})
    with pytest.raises(LogError, match='did you mean "F \\[foo\\]"'):
        read_table(path, channels={"F": "F [fo]"})


def test_a_line_of_two_gigabytes_is_not_loaded(tmp_path):
    import resource

    path = tmp_path / "line.csv"
    with path.open("wb") as stream:  # a sparse file: no disk is used
        stream.write(b"t [s],F [N]\n0,1\n1," + b"1" * 5000)
        stream.seek(2 << 30)
        stream.write(b"\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match="line 3 is longer than 1 MiB"):
        read_table(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10


def test_contents_lists_without_reading(file):
    found = contents(file("# bench\nt [ms];F [N];note\n0,5;1;a\n1;2;b\n"))
    assert [(item.name, item.kind, item.unit) for item in found.fields] == [
        ("t [ms]", "float64", "ms"),
        ("F [N]", "float64", "N"),
        ("note", "text", None),
    ]
    assert "CSV, 3 columns" in repr(found) and "1 line above the header passed over" in repr(found)


def test_an_unknown_unit_is_refused_where_others_are_known(file):
    with pytest.raises(UnitError, match='column "I \\[zorg\\]": unit "zorg" is not known'):
        read_table(file(b"time [s],I [zorg],F1 [N]\n0,1,2\n1,2,3\n"))


def test_an_index_in_brackets_is_no_unit(file):
    table = read_table(file(b"time [s],q[0],q[1],T [\xc2\xb0C]\n0,1,2,20\n1,2,3,21\n"))
    assert list(table.signals)[:2] == ["q[0]", "q[1]"]


def test_headers_that_repeat_are_numbered_and_those_over_two_lines_joined():
    assert _number_header("X [s]", 3) == "X#3 [s]"
    assert _join_quoted_lines(['t,"I', '[A]",F1', "x"]) == ['t,"I [A]",F1', "", "x"]


@pytest.mark.parametrize(
    ("header", "rate_hz"),
    [("time [s],clock", 1000), ("t [s],stamp", 1000), ("t_s,Clock", 1000), ("u,clock [us]", 1e6 / 24_000)],
)
def test_a_counter_named_clock_is_the_time_where_nothing_else_is(tmp_path, header, rate_hz):
    path, t = tmp_path / "log.csv", np.arange(200) * 1e-3
    rows = "\n".join(f"{at},{24_000 * i},{np.sin(at)}" for i, at in enumerate(t))
    path.write_text(f"{header},F1 [N]\n{rows}")
    assert so.read_log(path, channels={"F1": "F1 [N]"}).rate_hz == pytest.approx(rate_hz)


@pytest.mark.parametrize("header", ["uptime_ms", "elapsed_ms", "uptime [ms]", "millis [ms]"])
def test_the_time_since_a_board_was_switched_on_is_the_time_where_nothing_else_is(tmp_path, header):
    path, ticks = tmp_path / "log.csv", range(200)
    path.write_text("\n".join([f"{header},F1 [N]", *(f"{5000 + 2 * k},{np.sin(k)}" for k in ticks)]))
    assert so.read_log(path, channels={"F1": "F1 [N]"}).rate_hz == pytest.approx(500)
    path.write_text("\n".join([f"{header},F1 [N],time [s]", *(f"{5000 + 2 * k},{np.sin(k)},{k}" for k in ticks)]))
    assert so.read_log(path, channels={"F1": "F1 [N]"}).rate_hz == pytest.approx(1)


def test_columns_named_like_a_time_and_columns_that_wrap():
    assert [is_time_name(name) for name in ("Zeit [ms]", "stamp [ms]", "imu.t", "F1 [N]")] == [True, True, True, False]
    assert suspect_wrap(np.array([0.0, 3.0, 65530.0, 65535.0, 1.0]), 0.0, 65535.0) == 16
    assert spell_column(column="cur", unit="A") == 'column = "cur", unit = "A"'


def test_a_time_whose_name_ends_in_its_unit_is_the_time(file):
    log = read_log(file("time_ms,a [A]\n0,1\n2.5,2\n5,3\n"), channels={"a": "a [A]"})
    assert log.time == pytest.approx(TIME)


def test_a_last_line_that_is_cut_is_said_to_be_unfinished(file):
    with pytest.raises(LogError, match=r"line 4: .*the last line is unfinished; remove it"):
        read_log(file("t [s],a [A]\n0,1\n1,2\n2,-"), channels={"a": "a [A]"})
    with pytest.raises(LogError, match=r"line 3: .* is not a number; correct it"):
        read_log(file("t [s],a [A]\n0,1\n1,-\n2,3\n"), channels={"a": "a [A]"})
