"""Questions that logs leave open, with the answers given, and guesses for the others."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from seaopt.errors import ProblemError, suggestion
from seaopt.formatting import printable
from seaopt.records import record

UNKNOWN = "unknown"
# Questions whose guesses are no facts: the first sums up others, the second is a requirement.
WISHES = ("roles", "bandwidth_hz")
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})")  # or a German decimal


@record
class Question:
    """A question that the logs leave open."""

    key: str  # for the answers
    label: str  # in few words, for lists
    guess: str  # what is taken where nobody answers
    why: str  # where the guess is from
    choices: tuple[str, ...] = ()  # the answers that count; empty for a number
    open: bool = False  # whether "unknown" is an answer
    usual: tuple[float, float] | None = None  # the numbers outside which an answer is doubted
    detail: str = "?"  # what is said behind the label where it is asked: the unit, the choices

    @property
    def text(self) -> str:
        """The question as it is asked."""
        return self.label + self.detail

    @property
    def entry(self) -> str:
        """What it is called in the file's `guessed`."""
        return name_entry(self.key)

    def doubt(self, answer: str) -> str:
        """Return why an answer that counts is doubted; "" where it is not."""
        if self.usual is None or answer == UNKNOWN or self.usual[0] <= float(answer) <= self.usual[1]:
            return ""
        return f"{float(answer):.4g} is unusual, {self.usual[0]:g} to {self.usual[1]:g} are common"

    def read(self, answer: str) -> str:
        """Return an answer as it counts: a choice or the beginning of one, or a number. Raises ProblemError: it is none
        of the choices, or no positive number.
        """
        text = answer.strip()
        if self.choices:
            begins = [choice for choice in self.choices if text and choice.casefold().startswith(text.casefold())]
            exact = [choice for choice in begins if len(choice) == len(text)]
            if len(exact or begins) != 1:
                raise ProblemError(f'"{printable(text)}" is not an answer; {suggestion(text, self.choices)}')
            return (exact or begins)[0]
        if self.open and text.casefold() in (UNKNOWN, "?", "no", "n", "-"):
            return UNKNOWN
        if THOUSANDS.fullmatch(text):
            raise ProblemError(
                f'"{text}" may be {text.replace(",", ".")} or {text.replace(",", "")}; write one of them'
            )
        try:
            number = float(text.replace(",", "."))
        except ValueError:
            number = math.nan
        if not 0.0 < number < math.inf:
            or_unknown = f', or "{UNKNOWN}"' if self.open else ""
            raise ProblemError(f'"{printable(text)}" is not a positive number; give one{or_unknown}')
        return f"{number:.10g}"


class Interview:
    """Answers that are there, and the questions that came up on the way."""

    def __init__(self, answers: Mapping[str, str]) -> None:
        self.answers = dict(answers)
        self.questions: list[Question] = []
        self.assumed: dict[str, str] = {}  # why, by key

    def ask(self, key: str, label: str, guess: str, why: str = "", choices: Sequence[str] = (), **options: Any) -> str:
        """Return the answer to a question, or its guess; `options` are further fields of `Question`."""
        question = Question(key=key, label=label, guess=guess, why=why, choices=tuple(choices), **options)
        if all(question.key != other.key for other in self.questions):
            self.questions.append(question)
        return question.read(self.answers[key]) if key in self.answers else guess

    def number(self, key: str, label: str, guess: float, why: str = "", *, detail: str = "", **options: Any) -> float:
        """Return a number that is always known, or guessed."""
        return float(self.ask(key, label, f"{guess:.10g}", why, detail=detail, **options))

    def optional(self, key: str, label: str, why: str = "", *, detail: str = "", **options: Any) -> float | None:
        """Return a number, None where nobody knows it."""
        answer = self.ask(key, label, UNKNOWN, why, open=True, detail=f"{detail}, or {UNKNOWN}", **options)
        return None if answer == UNKNOWN else float(answer)

    def assume(self, key: str, why: str = "") -> None:
        """Note a guess that no answer replaces: nobody was asked, or nobody knew."""
        self.assumed.setdefault(key, why)

    def mark(self, *keys: str) -> str:
        """Return what of these answers is a guess, as the end of a comment; what is left to the fit is none."""
        reasons = [
            question.why or question.text
            for question in self.questions
            if question.key in keys
            and (question.key in self.assumed or (question.key not in self.answers and question.guess != UNKNOWN))
        ] or [why for key, why in self.assumed.items() if key in keys and why]
        return f"guessed: {'; '.join(reasons)}" if reasons else ""

    def list_doubts(self) -> dict[str, str]:
        """Return why answers are doubted, by the keys of their questions."""
        answered = {question.key: question for question in self.questions if question.key in self.answers}
        doubts = {key: question.doubt(question.read(self.answers[key])) for key, question in answered.items()}
        return {key: doubt for key, doubt in doubts.items() if doubt}

    def list_guessed(self) -> list[str]:
        """Return the guesses that results rest on: parameters, and other entries such as "unit of F1". Unknown values
        that are fitted are not among them, nor is the bandwidth, which is a requirement.
        """
        open_keys = [
            question.key
            for question in self.questions
            if question.key not in self.answers and question.guess != UNKNOWN and question.key not in WISHES
        ]
        return list(dict.fromkeys(name_entry(key) for key in (*open_keys, *self.assumed)))


def name_entry(key: str) -> str:
    """Return what a question's key is called in the file's `guessed`."""
    return key.replace(":", " of ", 1)
