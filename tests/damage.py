"""Results that somebody edited."""

from __future__ import annotations

import copy

import pytest

from seaopt.errors import FileError
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


def refuse(read, content, place, key, value, words, *, file):
    """Assert that a result with another value at a place is refused in one line, by its file and by what is wrong, and
    with the digest from before as edited. Return it as it would be written.
    """
    damaged, edited = damage(content, place, key, value)
    with pytest.raises(FileError, match=words) as caught:
        read(damaged)
    assert str(caught.value).startswith(file) and "\n" not in str(caught.value)
    with pytest.raises(FileError, match="edited"):
        read(edited)
    return damaged


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
