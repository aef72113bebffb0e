"""Segmenters that misbehave, installed for one test only. All others do the work of ``catheter-chain``."""

from __future__ import annotations

import ctypes
import time
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel

from fluoromap.contracts import NoParams
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain


class Hangs:
    """Never returns, and never asks whether it should stop."""

    name: ClassVar[str] = "hangs"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = NoParams

    def __init__(self, params: BaseModel) -> None:
        pass

    def segment(self, *inputs: Any) -> Any:
        while True:
            time.sleep(1)


class HoldsLock:
    """Holds the interpreter's lock for ``seconds``, so that no other thread of its process runs; then it works."""

    name: ClassVar[str] = "holds-lock"
    version: ClassVar[str] = "1"

    class Params(BaseModel):
        seconds: int

    def __init__(self, params: Params) -> None:
        self.seconds = params.seconds

    def segment(self, *inputs: Any) -> Any:
        # A function of a PyDLL keeps the lock while it runs.
        ctypes.PyDLL(None).sleep(self.seconds)
        return CatheterChain().segment(*inputs)


class ReturnsNone(Hangs):
    """Returns nothing."""

    name: ClassVar[str] = "returns-none"

    def segment(self, *inputs: Any) -> Any:
        return None


def install(folder: Path) -> None:
    """Write the metadata by which Python finds these plugins."""
    metadata = folder / "faulty_plugins-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty-plugins\nVersion: 1.0\n")
    names = {"hangs": "Hangs", "holds-lock": "HoldsLock", "returns-none": "ReturnsNone"}
    lines = [f"{name} = faulty_plugins:{kind}" for name, kind in names.items()]
    (metadata / "entry_points.txt").write_text("\n".join(["[fluoromap.segmenters]", *lines, ""]))
