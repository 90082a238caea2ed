"""The mistakes of the benchmark of the tests can be made: their lines are there, and what they change is one word."""

import ast
import re
from pathlib import Path

import pytest

from benchmarks.mistakes import MISTAKES, Mistake

ROOT = Path(__file__).parents[1]
WORD = r'"[^"]*"|[\w.]+|[<>=!]=|\S'


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda one: one.name)
def test_a_mistake_is_one_word_of_a_line_that_its_file_has_once(mistake: Mistake) -> None:
    before, after = (re.findall(WORD, line) for line in (mistake.before, mistake.after))
    assert len(before) == len(after)
    assert sum(old != new for old, new in zip(before, after, strict=True)) == 1
    wrong = mistake.made_in((ROOT / mistake.file).read_text(encoding="utf-8"))
    assert wrong.count(mistake.after) == 1 and mistake.before not in wrong
    ast.parse(wrong)
    assert any((ROOT / "tests" / test).is_file() for test in mistake.tests)
