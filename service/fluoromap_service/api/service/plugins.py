"""The route of the installed plugins."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from fluoromap import registry
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader

router = new_router(tags=["plugins"])


class Plugin(BaseModel):
    """An installed plugin; a broken plugin has the reason why it did not load."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "kind": "triangulator", "name": "linear", "version": "1", "distribution": "fluoromap",
                    "default": False, "parameters": {"type": "object", "properties": {}, "title": "NoParams"},
                    "error": None,
                }
            ]
        }
    )  # fmt: skip

    kind: registry.Kind
    name: str
    version: str | None = Field(description="Null where the plugin did not load.")
    distribution: str | None = Field(description="The installed package of the plugin.")
    default: bool = Field(description="Whether a job that names no plugin of this kind uses it.")
    parameters: dict[str, Any] | None = Field(
        description="JSON schema of its parameters; null where the plugin did not load."
    )
    error: str | None = Field(description="Why the plugin did not load.")


@router.get("/v1/plugins", summary="Installed plugins", response_model=list[Plugin], responses=responses(401, 403))
def list_plugins(caller: Reader) -> list[Plugin]:
    """List all installed segmenters, triangulators, monoplane solvers and fusers.

    A broken plugin is listed with its error.
    """
    return [
        Plugin(
            kind=row.kind,
            name=row.name,
            version=row.version,
            distribution=row.distribution,
            default=row.default,
            parameters=row.parameters,
            error=row.error,
        )
        for row in registry.plugins()
    ]
