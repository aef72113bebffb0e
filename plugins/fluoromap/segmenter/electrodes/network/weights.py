"""The network's weights: those of the package, or a lab's own file."""

from __future__ import annotations

import functools
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluoromap.segmenter.electrodes.network.ensemble import NetworkEnsemble

SHIPPED = Path(__file__).with_name("weights.npz")
"""Made by ``python -m fluoromap.training``; ``weights.json`` beside it has its SHA-256, command, seed and figures."""


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """Networks and what their answers are worth, from synthetic scenes they were not trained on.

    odds_gain, odds_offset : an electrode's log-odds are the gain times the networks' logit plus the offset.
    variance_gain : the squared error of a place over the variance that the networks state.
    """

    ensemble: NetworkEnsemble
    odds_gain: float
    odds_offset: float
    variance_gain: float


@functools.lru_cache(maxsize=4)
def read_weights(path: Path) -> Trained:
    """Read a weights file.

    Raises
    ------
    ValueError
        When it is not one, or one for another network.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name].astype(np.float32) for name in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as weights: make one with python -m fluoromap.training") from error
    calibration = arrays.pop("calibration", None)
    if calibration is None or calibration.shape != (3,):
        raise ValueError(f"{path} has no calibration: make it with python -m fluoromap.training of this version")
    gain, offset, variance = calibration.tolist()
    return Trained(NetworkEnsemble.of_weights(arrays), gain, offset, variance)
