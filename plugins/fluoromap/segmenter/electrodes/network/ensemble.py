"""Several networks of the same layers, trained from different seeds: what one alone says of a picture is luck."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluoromap.segmenter.electrodes.network.forward import ElectrodeNetwork, Part
from fluoromap.segmenter.electrodes.network.layers import HEADS
from fluoromap.segmenter.picture.log_image import Image

_OFFSETS = [HEADS.index(name) for name in ("offset_u", "offset_v")]
_LOG_VARIANCE = HEADS.index("log_variance")


@dataclass(frozen=True, slots=True, eq=False)
class NetworkEnsemble:
    """Networks that are asked about the same picture.

    Their mean answer errs less than each of them on pictures unlike those that they learned from (Lakshminarayanan et al., Simple
    and Scalable Predictive Uncertainty Estimation using Deep Ensembles, 2017).
    """

    networks: tuple[ElectrodeNetwork, ...]

    @classmethod
    def of_weights(cls, weights: dict[str, Image]) -> NetworkEnsemble:
        """Build from the arrays of :meth:`ElectrodeNetwork.of_weights`, each with a first axis of networks.

        Raises
        ------
        ValueError
            When a layer is missing or has another shape.
        """
        count = len(weights.get("heads.bias", ()))
        if not count:
            held = ", ".join(weights) or "nothing"
            raise ValueError(
                f"the weights hold no network, but {held}: make them with python -m fluoromap.training of this version"
            )
        return cls(
            tuple(
                ElectrodeNetwork.of_weights({name: array[k] for name, array in weights.items() if k < len(array)})
                for k in range(count)
            )
        )

    def __call__(self, picture: Image, cells: Part | None = None) -> Image:
        """Return the mean answers of cells; see :meth:`ElectrodeNetwork.__call__`.

        The variance of a place is that of the networks' mixture (section 2.4 there): the mean of the variances that they state, and
        how far apart their places lie.
        """
        answers = [network(picture, cells) for network in self.networks]
        if len(answers) == 1:
            return answers[0]
        mean: Image = np.mean(answers, axis=0)
        apart = np.mean([(one[..., _OFFSETS] - mean[..., _OFFSETS]) ** 2 for one in answers], axis=(0, -1))
        stated = np.mean([np.exp(one[..., _LOG_VARIANCE]) for one in answers], axis=0)
        mean[..., _LOG_VARIANCE] = np.log(stated + apart)
        return mean
