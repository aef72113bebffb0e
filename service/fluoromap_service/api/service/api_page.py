"""The page that describes the API to people, made from the OpenAPI document without any script."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

import fluoromap_service

WEB = Path(fluoromap_service.__path__[0]) / "web"
Json = dict[str, Any]


def api_page(document: Json) -> str:
    """Return the page of an OpenAPI document as HTML that needs no network."""
    groups: dict[str, list[Json]] = {}
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            tag = operation.get("tags", ["other"])[0]
            groups.setdefault(tag, []).append({"method": method.upper(), "path": path, **operation})
    template = _environment().get_template("api.html.j2")
    return template.render(info=document["info"], groups=groups, schemas=document["components"]["schemas"])


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(WEB), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters["prose"] = _prose
    environment.filters["kind"] = _kind
    return environment


def _prose(text: str) -> Markup:
    """Return text with its `code` marked as such and its paragraphs kept."""
    marked = re.sub(r"`+([^`]+)`+", r"<code>\1</code>", str(escape(text.strip())))
    return Markup("<br>".join(part.replace("\n", " ") for part in marked.split("\n\n")))


def _kind(schema: Json) -> Markup:
    """Return a schema in a few words.

    A schema with a name is a link to it.
    """
    if "$ref" in schema:
        name = escape(schema["$ref"].rsplit("/", 1)[-1])
        return Markup('<a href="#{0}">{0}</a>').format(name)
    for choice in ("anyOf", "oneOf"):
        if choice in schema:
            return Markup(" or ").join(_kind(item) for item in schema[choice])
    if "enum" in schema:
        return Markup(" or ").join(Markup("<code>{}</code>").format(value) for value in schema["enum"])
    if schema.get("type") == "array":
        return Markup("list of {}").format(_kind(schema.get("items", {})))
    kind = {"string": "text", "null": "null", "object": "object"}.get(schema.get("type", ""), schema.get("type", "any"))
    return escape("bytes" if schema.get("format") == "binary" else kind)
