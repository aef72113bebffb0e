"""Pictures of the map: overlays on fluoroscopy, the map from six directions, the propagation as an animation."""

from typing import Final

VERSION: Final = "4"
"""Version of the drawing code: kept pictures depend on it. Raise it with every change of a drawn pixel."""
