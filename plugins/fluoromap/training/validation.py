"""What trained networks' answers are worth, on synthetic scenes that they have not seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from fluoromap.contracts import Array
from fluoromap.segmenter.electrodes.network.ensemble import NetworkEnsemble
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.training.scenes import CLEAR, Scene

NEAR_PX = 4.0
"""A proposal this near to an electrode is right, at the network's scale."""

_ROUNDS = 25


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Every proposal's logit, whether it was right and its squared error over the stated variance; electrodes there were."""

    logits: Array
    right: Array
    squared: Array
    electrodes: int
    scenes: int

    def calibration(self) -> tuple[float, float, float]:
        """Return gain and offset of the log-odds, and the variance's gain.

        The first two follow from logistic regression, the last from the median squared error.
        """
        design = np.stack([self.logits, np.ones_like(self.logits)], axis=1)
        answer = np.array([1.0, 0.0])
        for _ in range(_ROUNDS):
            probability = 1.0 / (1.0 + np.exp(-design @ answer))
            curvature = design.T @ (design * (probability * (1.0 - probability))[:, None]) + 1e-6 * np.eye(2)
            answer = answer + np.linalg.solve(curvature, design.T @ (self.right - probability))
        # A squared error over its two-dimensional variance has the median 2 ln 2.
        variance = float(np.median(self.squared[self.right > 0])) / (2.0 * math.log(2.0))
        return float(answer[0]), float(answer[1]), variance

    def figures(self) -> dict[str, float]:
        """Return recall, precision and false proposals per scene.

        A proposal counts where the calibrated probability is 0.5 or more.
        """
        gain, offset, _ = self.calibration()
        taken = gain * self.logits + offset >= 0
        right = float(self.right[taken].sum())
        return {
            "recall": round(right / max(self.electrodes, 1), 4),
            "precision": round(right / max(int(taken.sum()), 1), 4),
            "false_a_scene": round((int(taken.sum()) - right) / self.scenes, 3),
        }


def validate(ensemble: NetworkEnsemble, scenes: Sequence[Scene]) -> Validation:
    """Compare the networks' proposals with the electrodes of the scenes.

    Proposals on electrodes that nobody could find are left out.
    """
    trained = Trained(ensemble, 1.0, 4.0, 1.0)
    logits, right, squared = [], [], []
    electrodes = 0
    for scene in scenes:
        everywhere = np.ones(scene.pixels.shape, np.bool_)
        x = scene.pixels.astype(np.float32)
        proposed = NetworkResponse.of_reduced(x, trained, 1.0).proposals(everywhere, 1)
        within = ((scene.electrodes_uv >= 0) & (scene.electrodes_uv <= len(x) - 1)).all(axis=1)
        clear = (scene.clearness >= CLEAR) & within
        electrodes += int(clear.sum())
        odds = np.log(proposed.probability / (1.0 - proposed.probability)) - 4.0
        if not len(proposed):
            continue
        away = np.linalg.norm(proposed.points_uv[:, None] - scene.electrodes_uv[None], axis=2)
        rows, columns = linear_sum_assignment(np.minimum(away, 4.0 * NEAR_PX))
        hit = {int(r): int(c) for r, c in zip(rows, columns, strict=True) if away[r, c] <= NEAR_PX}
        for row in range(len(proposed)):
            column = hit.get(row)
            if column is not None and not clear[column]:
                continue
            logits.append(float(odds[row]))
            right.append(float(column is not None))
            squared.append(away[row, column] ** 2 / proposed.variance_px2[row] if column is not None else 0.0)
    return Validation(np.array(logits), np.array(right), np.array(squared), electrodes, len(scenes))
