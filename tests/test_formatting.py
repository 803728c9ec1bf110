"""Numbers, lists and tables as texts, plain and HTML."""

from __future__ import annotations

import pytest

from seaopt import formatting

WRITTEN = [
    (formatting.format_number, (1.23456,), "1.235"),
    (formatting.format_number, (True,), "yes"),
    (formatting.format_number, (None,), "–"),
    (formatting.format_number, (float("inf"),), "∞"),
    (formatting.format_figure, (1.23456, "Hz"), "1.235 Hz"),
    (formatting.format_figure, (None, "Hz"), "–"),
    (formatting.format_figure, (7,), "7"),
    (formatting.printable, ("F1\x1b]0;title\x07",), r"F1\x1b]0;title\x07"),
    (formatting.format_band, ((0.5, 30.123), "Hz"), "0.5 to 30.12 Hz"),
    (formatting.format_band, (None, "Hz"), "none"),
    (formatting.format_values, ({"I_p": 0.3, "eta": 0.95},), "I_p = 0.3, eta = 0.95"),
    (formatting.format_percent, (0.12345,), "12.3 %"),
    (formatting.format_percent, (0.996, 2), "100 %"),
    (formatting.format_percent, (12.5, 2), "1200 %"),
    (formatting.format_percent, (0.999999, 6), "99.9999 %"),
    (formatting.format_percent, (0.05, 3, "+"), "+5 %"),
    (formatting.format_count, (1, "sample"), "1 sample"),
    (formatting.format_count, (3, "gap"), "3 gaps"),
    (formatting.tell_apart, ("fit", ["log"]), "fit"),
    (formatting.tell_apart, ("fit", ["fit", "fit 2"], " "), "fit 3"),
    (formatting.join_words, (["a"],), "a"),
    (formatting.join_words, (["a", "b", "c"],), "a, b and c"),
    (formatting.html_paragraph, ("a & b",), "<p>a &amp; b</p>"),
    (formatting.html_list, (["a"],), "<ul><li>a</li></ul>"),
    (formatting.html_list, ([],), ""),
    (formatting.html_text, ({"a": 1},), "<pre>{&#x27;a&#x27;: 1}</pre>"),
    (
        formatting.html_table, (["name"], [["Ms < 1.6"]]),
        "<table><thead><tr><th>name</th></tr></thead><tbody><tr><td>Ms &lt; 1.6</td></tr></tbody></table>",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("write", "values", "text"), WRITTEN)
def test_what_is_written(write, values, text):
    assert write(*values) == text


def test_values_without_any_are_what_stands_for_them():
    assert formatting.format_values({}, missing="nominal") == "nominal"


def test_columns_are_aligned():
    lines = list(formatting.format_table([("stand", "1.6"), ("swing", "1.45")], ("plant", "Ms"), "<>"))
    assert lines == ["plant    Ms", "stand   1.6", "swing  1.45"]
