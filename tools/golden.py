"""Write down the figures that a refactoring must keep, or compare with what is written down.

python tools/golden.py write [SUBJECT ...]     into tests/golden, one file per subject; all subjects if none is named
python tools/golden.py compare [SUBJECT ...]   prints each difference; exit code 1 if there is one

Numbers agree to 1e-9 of the larger one, those of a series also to the rounding of its largest, and those that are known
to less to what is stated with them; names, orders, verdicts and exit codes agree exactly. Sentences are compared with
--sentences only: their words may get better while figures stay.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "tests" / "golden"
RTOL, ATOL = 1e-9, 1e-14
SHOWN = 20  # differences of one subject that are printed


def main() -> int:
    """Run what the command line asks for."""
    sys.path.insert(0, str(ROOT / "tools"))
    from golden_subjects import SUBJECTS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("write", "compare", "list"))
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT")
    parser.add_argument("--sentences", action="store_true", help="compare what is said, too")
    given = parser.parse_args()
    if unknown := set(given.subjects) - set(SUBJECTS):
        parser.error(f"{', '.join(sorted(unknown))}: not a subject; expected some of {', '.join(SUBJECTS)}")
    if given.action == "list":
        say("\n".join(SUBJECTS))
        return 0
    changed = False
    for name in given.subjects or SUBJECTS:
        start = time.perf_counter()
        content = tidy(SUBJECTS[name]())
        took = f"{time.perf_counter() - start:.0f} s"
        path = FOLDER / f"{name}.json"
        if given.action == "write":
            path.parent.mkdir(exist_ok=True)
            path.write_text(json.dumps(content, indent=0) + "\n")
            say(f"{name}: written ({took})")
            continue
        if not path.is_file():
            say(f"{name}: nothing is written down yet; python tools/golden.py write {name}")
            changed = True
            continue
        differences = list(compare(json.loads(path.read_text()), content, "", sentences=given.sentences))
        say(f"{name}: {len(differences) or 'no'} difference{'' if len(differences) == 1 else 's'} ({took})")
        for line in differences[:SHOWN]:
            say(f"  {line}")
        changed = changed or bool(differences)
    return int(changed)


def say(text: str) -> None:
    """Print at once: a subject takes up to a minute."""
    print(text, flush=True)  # noqa: T201


def tidy(content: Any) -> Any:
    """Return content as JSON has it: numbers that are not finite as their names."""
    if isinstance(content, dict):
        return {str(key): tidy(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)) or hasattr(content, "tolist"):
        values = content.tolist() if hasattr(content, "tolist") else content
        return [tidy(value) for value in values] if isinstance(values, (list, tuple)) else tidy(values)
    return repr(content) if isinstance(content, float) and not math.isfinite(content) else content


def compare(before: Any, after: Any, place: str, *, sentences: bool, size: float = 1.0) -> Iterator[str]:
    """Yield a line for each difference; `size` is that of the largest of a series."""
    if isinstance(before, dict) and isinstance(after, dict) and "within" in before.keys() & after.keys():
        if not math.isclose(before["near"], after["near"], rel_tol=before["within"], abs_tol=ATOL):
            yield f"{place}: {before['near']!r} before, {after['near']!r} now, within {before['within']:g}"
    elif isinstance(before, dict) and isinstance(after, dict):
        if list(before) != list(after):
            gone, new = ([key for key in one if key not in two] for one, two in ((before, after), (after, before)))
            yield f"{place}: keys {f'gone: {gone}, new: {new}' if gone or new else 'in another order'}"
        for key in before:
            if key in after:
                yield from compare(before[key], after[key], f"{place}.{key}".lstrip("."), sentences=sentences)
    elif isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            yield f"{place}: {len(before)} values before, {len(after)} now"
        size = max((abs(value) for value in before if is_number(value)), default=1.0)
        for i, (one, two) in enumerate(zip(before, after, strict=False)):
            yield from compare(one, two, f"{place}[{i}]", sentences=sentences, size=max(size, 1.0))
    elif is_number(before) and is_number(after):
        if not math.isclose(before, after, rel_tol=RTOL, abs_tol=ATOL * size):
            yield f"{place}: {before!r} before, {after!r} now"
    elif before != after and (sentences or not (is_sentence(before) and is_sentence(after))):
        yield f"{place}: {before!r} before, {after!r} now"


def is_number(value: Any) -> bool:
    """Tell a number from a truth value."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_sentence(value: Any) -> bool:
    """Tell what is said from a name."""
    return isinstance(value, str) and value.count(" ") >= 2


if __name__ == "__main__":
    sys.exit(main())
