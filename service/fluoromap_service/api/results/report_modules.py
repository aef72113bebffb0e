"""The scripts of the report's 3D view: the same modules as the study page, packed into one file."""

from __future__ import annotations

import base64
import functools
import gzip
import hashlib
from pathlib import Path

ASSETS = Path(__file__).parents[2] / "web" / "assets"

MODULES = (
    "three/three.core.min.js",
    "three/three.module.min.js",
    "shared/elements.js",
    "shared/words.js",
    "shared/catheter-colours.js",
    "map/colour-scale.js",
    "map/colour-bar.js",
    "map/orientation.js",
    "map/orbit.js",
    "map/look.js",
    "map/site-text.js",
    "map/surface.js",
    "map/catheters.js",
    "map/scene.js",
    "map/panel.js",
)
"""Modules in the order in which they need each other; no two have the same file name."""


@functools.cache
def packed_modules() -> list[tuple[str, str]]:
    """Return file name and content of each module, gzip in base64."""
    return [(Path(name).name, _packed((ASSETS / name).read_bytes())) for name in MODULES]


@functools.cache
def modules_sha256() -> str:
    """Return the hash of all modules."""
    return hashlib.sha256(b"".join((ASSETS / name).read_bytes() for name in MODULES)).hexdigest()


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()
