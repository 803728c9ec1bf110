"""A law read from its file writes the same bytes, and nothing is simulated for it."""

from __future__ import annotations

import json

import seaopt as so
from seaopt.files import to_json


def test_a_controller_read_from_its_file_writes_the_same_bytes(tuned, no_simulation):
    written = to_json(tuned.to_dict())
    again = so.Controller.from_dict(json.loads(written), *tuned.design)
    assert to_json(again.to_dict()) == written and repr(again) == repr(tuned)
