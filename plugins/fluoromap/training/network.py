"""The electrode network in PyTorch, and its losses."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812 -- the name that PyTorch's own documentation uses
from torch import Tensor, nn

from fluoromap.segmenter.electrodes.network.layers import AROUND, CONVOLUTIONS, HEADS

EPSILON = 1e-5


class ElectrodeNetwork(nn.Module):
    """Proposes electrodes on a grid of 2 px from pictures of 2.3 to 4.6 px/mm.

    Features at a half, a quarter and an eighth of the size; what the eighth has seen of the surroundings (60 mm) is added to the
    quarter, which answers for the 2 x 2 cells of 2 px that it covers. Layers are those of
    :data:`~fluoromap.segmenter.electrodes.network.layers.CONVOLUTIONS`; all but the last two are followed by batch normalisation
    and a rectifier.

    In: (n, 1, rows, columns), rows and columns multiples of 8. Out: (n, 5, rows / 2, columns / 2), see
    :data:`~fluoromap.segmenter.electrodes.network.layers.HEADS`.
    """

    def __init__(self) -> None:
        super().__init__()
        for name, layer in CONVOLUTIONS.items():
            convolution = nn.Conv2d(
                layer.inputs, layer.outputs, layer.width, layer.stride, layer.width // 2 * layer.dilation, layer.dilation,
                bias=not layer.rectified,
            )  # fmt: skip
            self.add_module(name, convolution)
            if layer.rectified:
                self.add_module(f"{name}_norm", nn.BatchNorm2d(layer.outputs, eps=EPSILON))
        bias = self.get_submodule("heads").bias
        assert isinstance(bias, Tensor)
        with torch.no_grad():
            bias[:4] = -4.0

    def _layer(self, name: str, x: Tensor) -> Tensor:
        answer: Tensor = self.get_submodule(name)(x)
        if CONVOLUTIONS[name].rectified:
            answer = F.relu(self.get_submodule(f"{name}_norm")(answer))
        return answer

    def forward(self, x: Tensor) -> Tensor:
        half = self._layer("at_half", x)
        quarter = self._layer("at_quarter_again", self._layer("at_quarter", half))
        eighth = self._layer("at_eighth", quarter)
        for name in AROUND:
            eighth = eighth + self._layer(name, eighth)
        wide = F.interpolate(self._layer("back", eighth), scale_factor=2.0, mode="nearest")
        merged = self._layer("merged", quarter + wide)
        return F.pixel_shuffle(self._layer("heads", merged), 2)


def losses(answer: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the losses of heat, place, spread and tip.

    Parameters
    ----------
    answer : (n, 5, rows, columns)
        Of the network.
    target : (n, 5, rows, columns)
        Heat (1 on an electrode, -1 where no answer counts), offsets u and v in cells, tip, and 1 where the last three count.

    Heat has the focal loss of Zhou et al., Objects as Points (2019), eq. 1. The spread is the log-variance of the offset: its
    loss is the Gaussian log-likelihood of the offset's error, which itself it does not move.
    """
    heat = torch.sigmoid(answer[:, 0]).clamp(1e-5, 1.0 - 1e-5)
    wanted = target[:, 0]
    there, counts = (wanted >= 0.999).float(), (wanted >= 0.0).float()
    near = (1.0 - wanted.clamp(0.0, 1.0)) ** 4
    per_cell = there * (1.0 - heat) ** 2 * torch.log(heat) + (1.0 - there) * counts * near * heat**2 * torch.log(
        1.0 - heat
    )
    of_heat = -per_cell.sum() / there.sum().clamp(min=1.0)
    here = target[:, 4]
    total = here.sum().clamp(min=1.0)
    off = answer[:, 1:3] - target[:, 1:3]
    of_place = (off.abs().sum(1) * here).sum() / total
    log_variance = answer[:, 3].clamp(-8.0, 4.0)
    squares = (off.detach() ** 2).sum(1)
    of_spread = ((0.5 * squares * torch.exp(-log_variance) + log_variance) * here).sum() / total
    of_tip = (F.binary_cross_entropy_with_logits(answer[:, 4], target[:, 3], reduction="none") * here).sum() / total
    return of_heat, of_place, of_spread, of_tip


assert len(HEADS) == 5
