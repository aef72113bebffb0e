"""Trained network -> the weights file that segmenting reads, with its provenance beside it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fluoromap.segmenter.learned_chain.layers import CONVOLUTIONS
from fluoromap.training.network import ElectrodeNetwork


def folded(network: ElectrodeNetwork) -> dict[str, NDArray[np.float32]]:
    """Return each layer's taps and biases, batch normalisation folded in.

    Returns
    -------
    ``name.taps`` (width, width, inputs, outputs) and ``name.bias`` (outputs,).
    """
    state = {name: value.detach().double().cpu().numpy() for name, value in network.state_dict().items()}
    weights = {}
    for name, layer in CONVOLUTIONS.items():
        taps = state[f"{name}.weight"]
        if layer.rectified:
            gain = state[f"{name}_norm.weight"] / np.sqrt(state[f"{name}_norm.running_var"] + 1e-5)
            bias = state[f"{name}_norm.bias"] - state[f"{name}_norm.running_mean"] * gain
            taps = taps * gain[:, None, None, None]
        else:
            bias = state[f"{name}.bias"]
        weights[f"{name}.taps"] = taps.transpose(2, 3, 1, 0).astype(np.float32)
        weights[f"{name}.bias"] = bias.astype(np.float32)
    return weights


def halved(network: ElectrodeNetwork) -> dict[str, NDArray[np.float16]]:
    """Return the folded weights in half precision, as they are stored."""
    return {name: value.astype(np.float16) for name, value in folded(network).items()}


def write_weights(
    path: Path, weights: dict[str, NDArray[np.float16]], calibration: tuple[float, float, float], facts: dict[str, Any]
) -> None:
    """Write weights and calibration, and a ``.json`` file beside them.

    It holds these facts and the SHA-256 of the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    stored: dict[str, Any] = {**weights, "calibration": np.asarray(calibration, np.float32)}
    np.savez(path, **stored)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    described = {"sha256": digest, "torch": torch.__version__, **facts}
    path.with_suffix(".json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
