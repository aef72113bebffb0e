"""The configuration file: a TOML file with the targets of deliveries and the rules that start jobs."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

TableName = Literal["targets", "rules"]
_TABLES: tuple[TableName, ...] = ("targets", "rules")


def read_table(name: TableName, entry: TypeAdapter[Any]) -> dict[str, Any]:
    """Return the entries of a table of the configuration file, by their names.

    Without a configuration file there are none.

    Parameters
    ----------
    name : str
        Of the table.
    entry : TypeAdapter
        Type of an entry; the entry gets its name as the member ``name``.

    Raises
    ------
    Problem
        422 ``invalid_configuration`` when the file cannot be used; its sentence names the place.
    """
    content = _content()
    unknown = sorted(content.keys() - set(_TABLES))
    if unknown:
        raise invalid(f"unknown tables: {', '.join(unknown)}; the tables are targets and rules")
    table = content.get(name, {})
    if not isinstance(table, dict) or not all(isinstance(value, dict) for value in table.values()):
        raise invalid(f"write each entry as [{name}.NAME]")
    return {key: _entry(f"{name}.{key}", entry, {"name": key, **value}) for key, value in table.items()}


def invalid(reason: str) -> Problem:
    """Return the problem of a configuration file that cannot be used."""
    file = Path(settings().config).name
    return Problem(
        422,
        "invalid_configuration",
        f"The configuration file {file} cannot be used ({reason}); correct it and start again.",
    )


def _content() -> Mapping[str, Any]:
    if not settings().config:
        return {}
    try:
        return tomllib.loads(Path(settings().config).read_text())
    except OSError as error:
        raise invalid(f"{error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise invalid(str(error)) from None


def _entry(place: str, entry: TypeAdapter[Any], value: dict[str, Any]) -> Any:
    try:
        return entry.validate_python(value)
    except ValidationError as error:
        places = (f"{'.'.join([place, *map(str, item['loc'])])}: {item['msg']}" for item in error.errors())
        raise invalid("; ".join(places)) from None
