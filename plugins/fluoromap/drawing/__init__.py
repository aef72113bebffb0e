"""Pictures of the map: overlays on fluoroscopy, the map from six sides, the running activation."""

from typing import Final

VERSION: Final[str] = "1"
"""Raise it when a picture of the same map changes: pictures that the service keeps are then drawn again."""
