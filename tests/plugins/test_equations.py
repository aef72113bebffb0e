"""Each of the paper's equations has one function whose docstring names it, and a test whose name does."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import fluoromap.registry

EQUATIONS = range(1, 12)
PLUGINS = Path(fluoromap.registry.__file__).parent
TESTS = Path(__file__).parent
Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions(folder: Path) -> Iterator[tuple[Path, Function]]:
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, Function):
                yield path, node


def named_in_docstring(function: Function) -> set[int]:
    """Return the equations that a docstring cites as the paper's.

    Only "eq. (n) of the paper" counts: equations of other authors are cited in another form.
    """
    text = ast.get_docstring(function) or ""
    return {int(number) for number in re.findall(r"[Ee]q\. \((\d+)\) of the paper", text)}


def named_by_test(function: Function) -> set[int]:
    """Return the equations in a test's name.

    It is ``test_equation_4_...``, ``test_equations_8_9_10_...`` or ``test_..._equations_5_and_6_...``.
    """
    listed = re.search(r"equations?_(\d+(?:_(?:and_)?\d+)*)(?:_|$)", function.name)
    return {int(number) for number in re.findall(r"\d+", listed[1])} if listed else set()


@pytest.fixture(scope="module")
def holders() -> dict[int, list[str]]:
    found: dict[int, list[str]] = {number: [] for number in EQUATIONS}
    for path, function in functions(PLUGINS):
        for number in named_in_docstring(function):
            found[number].append(f"{path.relative_to(PLUGINS)}: {function.name}")
    return found


@pytest.fixture(scope="module")
def tested() -> set[int]:
    tests = (function for _, function in functions(TESTS) if function.name.startswith("test_"))
    return {number for function in tests for number in named_by_test(function)}


@pytest.mark.parametrize("number", EQUATIONS)
def test_one_function_is_the_equation(number: int, holders: dict[int, list[str]]) -> None:
    assert len(holders[number]) == 1, holders[number] or f"no function is eq. ({number}) of the paper"


@pytest.mark.parametrize("number", EQUATIONS)
def test_a_test_names_the_equation(number: int, tested: set[int]) -> None:
    assert number in tested


def test_the_audit_would_notice() -> None:
    def parsed(source: str) -> Function:
        node = ast.parse(source).body[0]
        assert isinstance(node, Function)
        return node

    assert named_in_docstring(parsed('def f():\n    "The filter, eq. (4) of the paper."')) == {4}
    assert named_in_docstring(parsed('def f():\n    "Rasmussen & Williams, equation (4)."')) == set()
    assert named_by_test(parsed("def test_equations_8_9_10_vanish(): ...")) == {8, 9, 10}
    assert named_by_test(parsed("def test_the_minus_sign_of_equation_7_sharpens(): ...")) == {7}
    assert named_by_test(parsed("def test_equation_4_agrees_with_1_twin(): ...")) == {4}
    assert named_by_test(parsed("def test_equality_of_11_points(): ...")) == set()
