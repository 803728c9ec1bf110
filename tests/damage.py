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


def put(content, keys, value):
    """Return content with another value at the end of some keys, without it if that is `...`."""
    changed = copy.deepcopy(content)
    table = changed
    for key in keys[:-1]:
        table = table[key]
    if value is ...:
        del table[keys[-1]]
    else:
        table[keys[-1]] = value
    return changed
