"""Results that somebody edited."""

from __future__ import annotations

import copy

from seaopt.files import seal


def damage(content, place, key, value):
    """Return a sealed result with another value at a place: as it would be written, and with the digest from before."""
    damaged = copy.deepcopy(content)
    table = damaged
    for part in place:
        table = table[part]
    assert table[key] != value
    table[key] = value
    return seal({name: each for name, each in damaged.items() if name != "made_from"}), damaged
