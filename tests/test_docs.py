"""The pages under ``docs/`` agree with the code: the drawing, the table of routes, the error codes, the words."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fluoromap.contracts import Fuser
from fluoromap.registry import _METHODS, GROUPS, _check
from fluoromap_service.api.app import create_app
from fluoromap_service.api.jobs.job_answers import job_answer
from fluoromap_service.api.results import points, tracks
from fluoromap_service.cli.app import COMMANDS
from fluoromap_service.deliveries import outbox
from fluoromap_service.dicom.errors import DicomCode
from fluoromap_service.dicom.facts import HeaderWarning
from fluoromap_service.jobs.pipeline import PIPELINE
from fluoromap_service.store.models import Job, JobState, StageRow, StageState

TOP = Path(__file__).parent.parent
DOCS = TOP / "docs"
PACKAGES = {
    "fluoromap": TOP / "plugins",
    "fluoromap_service": TOP / "service",
    "fluoromap_workers": TOP / "workers",
    "fluoromap_migrations": TOP / "migrations",
}
ONE_NODE = {"fluoromap_workers": "workers", "fluoromap_migrations": "migrations"}
"""Packages that are one node of the drawing."""
PAGES = ["README.md", "CONTRIBUTING.md", *sorted(f"docs/{path.name}" for path in DOCS.glob("*.md"))]

Arrows = set[tuple[str, str]]


# --- the drawing -------------------------------------------------------------------------------------------------------


def modules() -> dict[str, Path]:
    """Return the modules of the four packages, dotted name -> file."""
    found = {}
    for package, root in PACKAGES.items():
        for path in (root / package).rglob("*.py"):
            parts = path.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def node_of(module: str) -> str | None:
    """Return the node of a module; None for an ``__init__``."""
    package, *rest = module.split(".")
    if package in ONE_NODE:
        return ONE_NODE[package]
    if not rest:
        return None
    if rest[0] == "api":
        return f"api.{rest[1]}" if len(rest) > 1 else None
    return f"{'science' if package == 'fluoromap' else 'service'}.{rest[0]}"


def label_of(node: str) -> str:
    """Return a node's folder with a slash, or its file name."""
    for package, name in ONE_NODE.items():
        if node == name:
            return f"{package}/"
    floor, _, name = node.partition(".")
    service = PACKAGES["fluoromap_service"] / "fluoromap_service"
    folders = {"science": PACKAGES["fluoromap"] / "fluoromap", "service": service, "api": service / "api"}
    return f"{name}/" if (folders[floor] / name).is_dir() else f"{name}.py"


def imported(path: Path) -> Iterator[str]:
    """Yield the full names that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def arrows_of_the_code(found: dict[str, Path]) -> Arrows:
    """Return the arrows between nodes that the imports make."""
    arrows = set()
    for module, path in found.items():
        for target in imported(path):
            while target and target not in found:
                target = target.rpartition(".")[0]
            ends = node_of(module), node_of(target) if target else None
            if ends[0] and ends[1] and ends[0] != ends[1]:
                arrows.add((ends[0], ends[1]))
    return arrows


def below(node: str, arrows: Arrows) -> set[str]:
    """Return every node that chains of arrows lead to."""
    reached: set[str] = set()
    waiting = [node]
    while waiting:
        for _, end in (arrow for arrow in arrows if arrow[0] == waiting[0]):
            if end not in reached:
                reached.add(end)
                waiting.append(end)
        waiting.pop(0)
    return reached


def without_shortcuts(arrows: Arrows) -> Arrows:
    """Return the arrows that no longer chain replaces."""
    reached = {start: below(start, arrows) for start in {end for arrow in arrows for end in arrow}}
    return {
        (start, end)
        for start, end in arrows
        if not any(end in reached[other] for first, other in arrows if first == start and other != end)
    }


def drawing() -> str:
    """Return the text of the one drawing of packages."""
    drawings = re.findall(r"^```mermaid\nflowchart.*?^```", (DOCS / "architecture.md").read_text(), re.M | re.S)
    assert len(drawings) == 1
    return str(drawings[0])


def test_drawing_shows_every_folder_and_no_other() -> None:
    found = modules()
    drawn = dict(re.findall(r"^\s*([\w.]+)\[\"([^\"]+)\"\]$", drawing(), re.M))
    nodes = {node for module in found if (node := node_of(module)) is not None}
    assert drawn == {node: label_of(node) for node in nodes}


def test_drawing_shows_the_imports_of_the_code() -> None:
    drawn = set(re.findall(r"^\s*([\w.]+) --> ([\w.]+)$", drawing(), re.M))
    expected = without_shortcuts(arrows_of_the_code(modules()))
    assert drawn == expected, f"missing: {sorted(expected - drawn)}; not in the code: {sorted(drawn - expected)}"


def test_imports_have_no_circle() -> None:
    arrows = arrows_of_the_code(modules())
    assert not [start for start, _ in arrows if start in below(start, arrows)]


def test_shortcuts_are_left_out() -> None:
    assert without_shortcuts({("a", "b"), ("b", "c"), ("a", "c"), ("a", "d")}) == {("a", "b"), ("b", "c"), ("a", "d")}


def test_table_of_stages_is_the_pipeline() -> None:
    rows = table_under(DOCS / "architecture.md", "How a study passes through")
    listed = [(name, kind, subject, depends, fails) for name, kind, subject, depends, fails, _ in rows]
    assert listed == [
        (
            f"`{stage.name}`",
            stage.kind or "",
            stage.subject,
            ", ".join(f"`{name}`" for name in stage.depends_on),
            f"the {stage.subject if stage.fails == 'subject' else 'job'}",
        )
        for stage in PIPELINE
    ]


# --- the contract at the doors -----------------------------------------------------------------------------------------


def test_page_of_the_api_lists_every_route_and_no_other() -> None:
    rows = re.findall(r"^\| `(GET|POST|PUT|PATCH|DELETE) (/\S+)` \|", (DOCS / "api.md").read_text(), re.M)
    paths = create_app().openapi()["paths"]
    assert len(rows) == len(set(rows))
    assert set(rows) == {(method.upper(), path) for path, methods in paths.items() for method in methods}


def test_page_of_the_api_lists_the_query_parameters() -> None:
    page = (DOCS / "api.md").read_text()
    rows = {(m, p): rest for m, p, rest in re.findall(r"^\| `([A-Z]+) (/\S+)` \|(.*)$", page, re.M)}
    for path, methods in create_app().openapi()["paths"].items():
        for method, operation in methods.items():
            asked = {p["name"] for p in operation.get("parameters", []) if p["in"] == "query"} - {"limit", "cursor"}
            missing = {name for name in asked if f"`{name}" not in rows[method.upper(), path]}
            assert not missing, f"{method.upper()} {path}: {missing}"


@pytest.mark.parametrize("columns", [points.COLUMNS, tracks.COLUMNS], ids=["points", "tracks"])
def test_page_of_the_api_gives_the_columns_of_the_tables(columns: tuple[str, ...]) -> None:
    assert f"```\n{','.join(columns)}\n```" in (DOCS / "api.md").read_text()


def test_page_of_the_api_lists_the_warnings_of_a_header() -> None:
    rows = re.findall(r"^\| `(\w+)` \| header \|", (DOCS / "api.md").read_text(), re.M)
    assert sorted(rows) == sorted(HeaderWarning)


# --- errors ------------------------------------------------------------------------------------------------------------


def codes_of_the_source() -> set[tuple[str, int]]:
    """Return the codes of problems with their status.

    They are literals of ``Problem``, the codes of DICOM files, and the names for HTTP's own errors.
    """
    codes = {(str(code), code.status) for code in DicomCode}
    for root in (TOP / "service", TOP / "workers"):
        for path in root.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Problem":
                    status, code = (part.value if isinstance(part, ast.Constant) else None for part in node.args[:2])
                    if isinstance(status, int) and isinstance(code, str):
                        codes.add((code, status))
                if isinstance(node, ast.Dict) and path.name == "problems.py":
                    pairs = [
                        (key.value, value.value)
                        for key, value in zip(node.keys, node.values, strict=True)
                        if isinstance(key, ast.Constant) and isinstance(value, ast.Constant)
                    ]
                    codes |= {(str(code), status) for status, code in pairs if isinstance(status, int)}
    return codes


def codes_of_stages() -> set[str]:
    """Return the codes that jobs and workers store with a stage."""
    codes = set()
    for path in [*(TOP / "service" / "fluoromap_service" / "jobs").rglob("*.py"), *(TOP / "workers").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Dict):
                for key, value in zip(node.keys, node.values, strict=True):
                    named = isinstance(key, ast.Constant) and key.value == "code"
                    if named and isinstance(value, ast.Constant) and isinstance(value.value, str):
                        codes.add(value.value)
    return codes


def table_under(page: Path, heading: str) -> list[tuple[str, ...]]:
    """Return the rows of the table under a heading, without its head."""
    section = re.split(r"^## ", page.read_text(), flags=re.M)
    text = next(part for part in section if part.startswith(heading))
    rows = [tuple(cell.strip() for cell in line[1:-1].split("|")) for line in re.findall(r"^\|.*\|$", text, re.M)]
    return rows[2:]


def test_page_of_errors_lists_every_code_with_its_status() -> None:
    rows = table_under(DOCS / "errors.md", "Answers of the service")
    listed = [(code.strip("` "), int(status)) for code, status, *_ in rows]
    assert len(listed) == len(set(listed))
    assert set(listed) == codes_of_the_source()
    assert listed == sorted(listed)


def test_page_of_errors_lists_every_code_of_a_stage_with_its_status() -> None:
    rows = table_under(DOCS / "errors.md", "Errors of a stage")
    listed = {code.strip("` "): int(status) for code, status, *_ in rows}
    assert set(listed) == codes_of_stages()
    job = Job(id="j", study_id="s", state=JobState.RUNNING, snapshot={}, version=0, created=0.0)
    stage = StageRow(
        id=1, job_id="j", name="segment", subject="1.2", plugin="p", plugin_version="1", depends_on=[],
        state=StageState.FAILED, attempt=1, progress=0.0, reused=False,
    )  # fmt: skip
    for code, status in listed.items():
        stage.error = {"code": code, "detail": "It failed."}
        error = job_answer(job, [stage]).stages[0].error
        assert error is not None
        assert (error.code, error.status) == (code, status)


def test_page_of_errors_lists_every_code_of_a_delivery() -> None:
    codes = set()
    for path in [*(TOP / "service" / "fluoromap_service").glob("sender/*.py"), Path(outbox.__file__)]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("NotDelivered", "Failure") and node.args:
                code = node.args[0]
                if isinstance(code, ast.Constant):
                    codes.add(code.value)
    rows = table_under(DOCS / "errors.md", "Errors of a delivery")
    assert [code.strip("` ") for code, *_ in rows] == sorted(codes)


def test_every_error_has_a_cause_and_a_remedy() -> None:
    for heading, cells in (("Answers of the service", 4), ("Errors of a stage", 4), ("Errors of a delivery", 3)):
        for row in table_under(DOCS / "errors.md", heading):
            assert len(row) == cells, row
            assert all(len(cell.split()) >= 2 and cell.endswith(".") for cell in row[-2:]), row


# --- words, paths and commands -----------------------------------------------------------------------------------------


def test_glossary_is_in_alphabetical_order() -> None:
    terms = re.findall(r"^\*\*(.+?)\*\*", (DOCS / "glossary.md").read_text(), re.M)
    assert len(terms) > 50
    assert terms == sorted(terms, key=lambda term: term.replace("-", " ").casefold())
    assert len({term.casefold() for term in terms}) == len(terms)


def test_example_of_a_plugin_is_a_plugin() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", (TOP / "CONTRIBUTING.md").read_text(), re.M | re.S)
    assert len(blocks) == 1
    names: dict[str, Any] = {}
    exec(blocks[0], names)
    _check("fuser", "my-surface", names["MySurface"])
    assert isinstance(names["MySurface"](names["Params"]()), Fuser)


def test_methods_of_plugins_are_listed() -> None:
    page = (TOP / "CONTRIBUTING.md").read_text()
    assert dict(re.findall(r"^\| `(fluoromap\.\w+)` \| `(\w+)` \|$", page, re.M)) == {
        group: _METHODS[kind] for kind, group in GROUPS.items()
    }


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_exist(page: str) -> None:
    for name in re.findall(
        r"`((?:plugins|service|workers|migrations|tests|benchmarks|docs)/[\w./-]*)`", (TOP / page).read_text()
    ):
        assert (TOP / name).exists(), name


@pytest.mark.parametrize("page", PAGES)
def test_anchors_of_links_exist(page: str) -> None:
    for target, anchor in re.findall(r"\]\(([\w./-]*)#([\w-]+)\)", (TOP / page).read_text()):
        text = ((TOP / page).parent / target if target else TOP / page).read_text()
        headings = re.findall(r"^#+ (.+)$", text, re.M)
        slugs = [re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings]
        assert anchor in slugs, f"{target}#{anchor}"


@pytest.mark.parametrize("page", PAGES)
def test_commands_that_a_page_names_exist(page: str) -> None:
    named = re.findall(r"(?:`|\./run |api )fluoromap ([a-z][a-z-]*)", (TOP / page).read_text())
    assert set(named) <= set(COMMANDS)


def test_every_page_is_linked_from_the_readme() -> None:
    readme = (TOP / "README.md").read_text()
    for path in DOCS.glob("*.md"):
        assert f"(docs/{path.name})" in readme, path.name
