"""The protocols of the kinds of stage."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts.context import Context
from fluoromap.contracts.fusion import ChamberMap, MappedSite
from fluoromap.contracts.matching import MatchedSite
from fluoromap.contracts.monoplane import MonoplaneView, Track
from fluoromap.contracts.segmentation import Marks, Preview, Run, Segmentation
from fluoromap.contracts.triangulation import Triangulation


class NoParams(BaseModel, extra="forbid"):
    """The ``Params`` of a stage that has none."""


# A plugin is a class ``PluginClass(params)`` with the method of one of these protocols, used for one subject at a time. It has
# name : as clients write it.
# version : a string that changes whenever the result of the same input changes; results are stored under it.
# Params : a pydantic model with ``extra="forbid"``, and a default and a description for each field.
# A plugin with kernels to compile may have a class method ``warm_up()``: a worker process calls it before it takes work.
# A stage may raise :class:`Refusal`.


@runtime_checkable
class Segmenter(Protocol):
    """Finds the catheters' electrodes in the frames of one run; does not name look-alikes."""

    def segment(self, run: Run, catalogue: Catalogue, marks: Marks, context: Context) -> Segmentation: ...


@runtime_checkable
class Previewer(Protocol):
    """A segmenter that also shows the electrodes of one frame before the geometry of the run is complete."""

    def preview(self, run: Run, catalogue: Catalogue, frame: int, scale_is_known: bool) -> Preview: ...


@runtime_checkable
class Triangulator(Protocol):
    """Locates the named electrodes of all sites of a study in 3D."""

    def triangulate(self, sites: tuple[MatchedSite, ...], catalogue: Catalogue, context: Context) -> Triangulation: ...


@runtime_checkable
class MonoplaneSolver(Protocol):
    """Tracks the electrodes in 3D through one view."""

    def track(self, view: MonoplaneView, context: Context) -> Track: ...


@runtime_checkable
class Fuser(Protocol):
    """Makes surface and map of the located sites."""

    def fuse(self, sites: tuple[MappedSite, ...], context: Context) -> ChamberMap: ...
