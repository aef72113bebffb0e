"""Trained network -> the weights file that segmenting reads, with its provenance beside it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fluoromap.segmenter.electrodes.network.forward import ElectrodeNetwork as SegmentersNetwork
from fluoromap.segmenter.electrodes.network.layers import CONVOLUTIONS
from fluoromap.training.network import EPSILON, ElectrodeNetwork

REFERENCE_SHAPE = 32, 40

_ROUNDING = 2e-3


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
            gain = state[f"{name}_norm.weight"] / np.sqrt(state[f"{name}_norm.running_var"] + EPSILON)
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


def stacked(networks: Sequence[dict[str, NDArray[np.float16]]]) -> dict[str, NDArray[np.float16]]:
    """Return the weights of several networks in arrays with a first axis of networks."""
    return {name: np.stack([network[name] for network in networks]) for name in networks[0]}


def check_folded(trained: ElectrodeNetwork) -> None:
    """Check that the segmenter's network with folded weights answers as the trained one does.

    Raises
    ------
    ArithmeticError
        Where the two differ by more than rounding.
    """
    picture = np.random.default_rng(1).normal(size=REFERENCE_SHAPE).astype(np.float32)
    with torch.no_grad():
        expected = trained(torch.from_numpy(picture[None, None]))[0].permute(1, 2, 0).numpy()
    worst = float(np.abs(SegmentersNetwork.of_weights(folded(trained))(picture) - expected).max())
    if worst > _ROUNDING:
        raise ArithmeticError(f"the folded network differs from the trained one by {worst:.3g}: compare their layers")


def of_file(path: Path) -> list[ElectrodeNetwork]:
    """Return the PyTorch networks of a weights file, their normalisation folded into the taps."""
    with np.load(path) as stored:
        weights = {name: stored[name].astype(np.float32) for name in stored.files}
    return [_of_weights(weights, number) for number in range(len(weights["heads.bias"]))]


def _of_weights(weights: dict[str, NDArray[np.float32]], number: int) -> ElectrodeNetwork:
    network: ElectrodeNetwork = ElectrodeNetwork().eval()
    with torch.no_grad():
        for name, layer in CONVOLUTIONS.items():
            convolution = network.get_submodule(name)
            taps = torch.from_numpy(weights[f"{name}.taps"][number].transpose(3, 2, 0, 1).copy())
            bias = torch.from_numpy(weights[f"{name}.bias"][number])
            convolution.get_parameter("weight").copy_(taps)
            if layer.rectified:
                normalisation = network.get_submodule(f"{name}_norm")
                normalisation.get_buffer("running_var").fill_(1.0 - EPSILON)
                normalisation.get_parameter("bias").copy_(bias)
            else:
                convolution.get_parameter("bias").copy_(bias)
    return network


def write_reference(path: Path, weights: Path) -> None:
    """Write what PyTorch answers to a small picture with the weights of a file.

    The arrays are ``picture`` (rows, columns), ``answers`` (networks, rows / 2, columns / 2, heads) and ``sha256`` of the weights.
    """
    picture = np.random.default_rng(0).normal(size=REFERENCE_SHAPE).astype(np.float16)
    asked = torch.from_numpy(picture.astype(np.float32)[None, None])
    with torch.no_grad():
        answers = [network(asked)[0].permute(1, 2, 0).numpy() for network in of_file(weights)]
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    np.savez(path, picture=picture, answers=np.stack(answers), sha256=np.array(digest))


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
