"""Nobody takes what a result says apart: results have fields, and words are made of them in one place."""

from __future__ import annotations

import ast
from pathlib import Path

SEAOPT = Path(__file__).resolve().parents[1] / "seaopt"
# Names of what is said. A search of them, or a cut, is a sentence that is parsed.
SAID = {"text", "where", "reason", "message", "sentence", "explanation", "verdict", "said", "remedy", "summary",
        "label", "draws", "proof", "assumption", "statement", "what", "str", "error"}  # fmt: skip
LISTS = {"active_constraints", "blocked_by", "broken", "explanations", "labels", "notes", "reasons", "remarks",
         "sentences", "texts"}  # of what is said: their entries are, under any name  # fmt: skip
CUTS = {"split", "rsplit", "partition", "rpartition", "startswith", "endswith", "find", "index", "removeprefix",
        "removesuffix", "replace"}  # fmt: skip
PATTERNS = {"search", "match", "fullmatch", "findall", "finditer", "split"}  # verbs of a regular expression that read
# What is read there, and why it is no sentence of a result, or what it waits for.
READERS = {
    "cli/frontier.py": "an argument of the command line",
    "cli/inspect.py": "an argument of the command line",
    "cli/terminal.py": "blanks of an error's text, and whether it names something to type",
    "errors.py": "blanks of an error's text",
    "files.py": "Python's own text of an error, without its advice to programmers",
    "estimation/result/identifiability.py": "EXPERIMENT.NAME of an unknown",
    "fleet/history.py": "names of logs, in which numbers are sorted",
    "fleet/result.py": "a log's own name in its reason, so that reasons of several logs are counted as one",
    "logs": "columns and files",
    "plants": "equations and files",
    "problem/proposal/questions.py": "answers",
    "reporting/page/chart.py": "matplotlib's mark of a line without a label",
    "reporting/sections/kinds/fit.py": "a message that an error repeats is not said twice",
    "robustness": "names of draws and conditions, and blanks of a wrong value",
    "units.py": "a unit's own text",
}
CALLS_IN_ROBUSTNESS = {"str(name).removesuffix('_hz')", "name in draws"}


def name_of(node):
    """Return the last name of an expression."""
    match node:
        case ast.Call(func=ast.Name(id="str" | "repr")):
            return "str"
        case ast.Call(func=function):
            return name_of(function)
        case ast.Attribute(attr=name) | ast.Name(id=name):
            return name
        case ast.Subscript(slice=ast.Constant(value=str(key))) if key in SAID:
            return key
        case ast.Subscript(value=value):
            return name_of(value)
        case ast.BoolOp(values=[value, *_]):
            return name_of(value)
    return ""


def list_parsed(source):
    """Yield what cuts or searches something that is said."""
    tree = ast.parse(source)
    loops = [node for node in ast.walk(tree) if isinstance(node, ast.For | ast.comprehension)]
    said = SAID | {
        loop.target.id for loop in loops if isinstance(loop.target, ast.Name) and name_of(loop.iter) in LISTS
    }
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Attribute(attr=verb, value=value)) if verb in CUTS and name_of(value) in said:
                yield ast.unparse(node)
            case ast.Call(func=ast.Attribute(attr=verb), args=[*_, text]) if verb in PATTERNS and name_of(text) in said:
                yield ast.unparse(node)
            case ast.Compare(ops=[ast.In() | ast.NotIn()], comparators=[value]) if name_of(value) in said:
                yield ast.unparse(node)


def test_the_search_finds_what_was_parsed_before():
    source = "plant = row.where.split(':')[0]\nhead = str(draws).partition(':')\nunstable = 'UNSTABLE' in row.text\n"
    source += "first = re.split(', ', question.text)[0]\nsize = _NUMBER.search(finding.text)\n"
    source += "easing = [name.partition(' (')[0] for name in controller.active_constraints]\n"
    source += "text = str(error).replace(draft, target)\nkind = errors[0]['where'].removeprefix(name)\n"
    source += "reason = (reason or '').replace(log, 'LOG')\nnamed = name in error\n"
    assert len(list(list_parsed(source))) == 10


def test_no_sentence_of_a_result_is_parsed():
    found = {
        path.relative_to(SEAOPT).as_posix(): parsed
        for path in SEAOPT.rglob("*.py")
        if (parsed := list(list_parsed(path.read_text(encoding="utf-8"))))
    }
    covers = {known: [path for path in found if path == known or path.startswith(f"{known}/")] for known in READERS}
    assert set(found) == {path for paths in covers.values() for path in paths}
    assert [known for known, paths in covers.items() if not paths] == []  # an exception that nothing needs
    in_robustness = {each for path, parsed in found.items() if path.startswith("robustness/") for each in parsed}
    assert {each for each in in_robustness if "repr(value)" not in each} == CALLS_IN_ROBUSTNESS
