"""The chamber as a mesh file: PLY, STL, GLB, VTP, OpenEP and CSV."""

from typing import Final

VERSION: Final[str] = "2"
"""Raise it when the file of the same map changes: files that the service keeps are then written again."""
