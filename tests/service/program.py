"""An answer of the program, as a user reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Answer:
    returncode: int
    stdout: str
    stderr: str


Program = Callable[..., Answer]


def one_sentence(answer: Answer, code: int = 1) -> str:
    assert answer.returncode == code, answer.stderr
    assert answer.stderr.startswith("fluoromap: ")
    assert answer.stderr.count("\n") == 1
    return answer.stderr
