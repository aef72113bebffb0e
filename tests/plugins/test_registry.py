"""Plugins are found by entry point; broken ones are rows, not crashes."""

from importlib.metadata import EntryPoint
from typing import ClassVar

import pytest
from pydantic import BaseModel, ValidationError

from fluoromap import registry
from fluoromap.contracts import NoParams


class Working:
    name: ClassVar[str] = "working"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = NoParams

    def fuse(self) -> None: ...


class Again(Working):
    name: ClassVar[str] = "working"


class WithoutMethod:
    name: ClassVar[str] = "without-method"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = NoParams


class ParamsNotAModel(Working):
    name: ClassVar[str] = "params-not-a-model"
    Params = dict  # type: ignore[assignment]


@pytest.fixture
def entry(monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """Entry points that load the classes of this file, or fail to load."""
    known = {cls.__name__: cls for cls in (Working, Again, WithoutMethod, ParamsNotAModel)}

    class Point(EntryPoint):
        def load(self):  # type: ignore[no-untyped-def]
            return known[self.value] if self.value in known else super().load()

    return lambda name, value: Point(name, value, "fluoromap.fusers")


def test_a_working_plugin_is_a_row_with_its_parameters(entry) -> None:  # type: ignore[no-untyped-def]
    (row,) = registry.discover("fuser", [entry("working", "Working")])
    assert row.stage is Working
    assert row.error is None
    assert row.version == "1"
    assert row.parameters == NoParams.model_json_schema()


def test_a_plugin_that_does_not_import_is_a_row_with_its_traceback(entry) -> None:  # type: ignore[no-untyped-def]
    good, broken = registry.discover(
        "fuser", [entry("working", "Working"), entry("zz-broken", "no_such_module_here:Fuser")]
    )
    assert good.error is None
    assert broken.stage is None
    assert broken.parameters is None
    assert "Traceback" in (broken.error or "")
    assert "ModuleNotFoundError" in (broken.error or "")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("without-method", "WithoutMethod", "has no 'fuse'"),
        ("other-name", "Working", "calls itself 'working'"),
        ("params-not-a-model", "ParamsNotAModel", "pydantic model"),
    ],
)
def test_a_class_that_is_no_stage_is_reported_with_what_it_lacks(entry, name: str, value: str, words: str) -> None:  # type: ignore[no-untyped-def]
    (row,) = registry.discover("fuser", [entry(name, value)])
    assert row.stage is None
    assert words in (row.error or "")


def test_of_two_plugins_with_one_name_the_first_is_used(entry) -> None:  # type: ignore[no-untyped-def]
    first, second = registry.discover("fuser", [entry("working", "Working"), entry("working", "Again")])
    assert [first.stage, second.stage].count(None) == 1
    assert first.stage is Again  # by the order of their modules and classes, whatever order they were found in
    assert "found first" in (second.error or "")


def test_unknown_and_broken_plugins_are_distinguished(entry, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    rows = registry.discover("fuser", [entry("working", "Working"), entry("zz-broken", "no_such_module_here:Fuser")])
    monkeypatch.setattr(registry, "plugins", lambda: rows)
    assert registry.plugin("fuser", "working").stage is Working
    with pytest.raises(registry.UnknownPlugin, match="does not load"):
        registry.plugin("fuser", "zz-broken")
    with pytest.raises(registry.UnknownPlugin, match="installed are working"):
        registry.plugin("fuser", "nobody")


def test_the_installed_triangulators_and_monoplane_solvers_load() -> None:
    rows = {(row.kind, row.name): row for row in registry.plugins()}
    for kind, name in (
        ("triangulator", "linear"),
        ("triangulator", "maximum-likelihood"),
        ("monoplane", "a-priori-lm"),
        ("monoplane", "motion-prior"),
        ("monoplane", "rigid-pose"),
    ):
        assert rows[kind, name].error is None  # type: ignore[index]
    assert rows["triangulator", registry.DEFAULTS["triangulator"]].default


def test_bad_parameters_name_the_field() -> None:
    with pytest.raises(ValidationError, match="beat_sd_mm"):
        registry.build_triangulator("linear", {"beat_sd_mm": -1})
    with pytest.raises(ValidationError, match="no_such"):
        registry.build_monoplane("rigid-pose", {"no_such": 1})


@pytest.mark.parametrize("kind", list(registry.GROUPS))
def test_every_parameter_has_a_default_and_a_description(kind: registry.Kind) -> None:
    for row in registry.plugins():
        if row.kind == kind and row.stage is not None:
            row.stage.Params()
            for name, field in row.stage.Params.model_fields.items():
                assert field.description, f"{row.name}: {name}"
