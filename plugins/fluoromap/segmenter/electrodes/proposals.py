"""The seam between finding single electrodes and making chains of them: what a proposer says about one image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

import numpy as np

from fluoromap.contracts import Array, BoolArray, frozen
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.picture.shaft_image import ShaftImage

_LEAST_LINE, _LINE_NOISE = 0.03, 0.6
"""Depth of a clear shaft, log units: at least, and over the noise of a pixel."""


@dataclass(frozen=True, eq=False)
class Proposals:
    """Electrodes that one image may show, best first.

    points_uv : (n, 2) pixels of the frame. probability : (n,) that an electrode is there, 0 to 1.
    covariance_px2 : (n, 2, 2) of its place, pixels squared.
    """

    points_uv: Array
    probability: Array
    covariance_px2: Array

    def __post_init__(self) -> None:
        count = len(self.points_uv)
        object.__setattr__(self, "points_uv", frozen(self.points_uv, (None, 2), "points_uv"))
        object.__setattr__(self, "probability", frozen(self.probability, (count,), "probability"))
        object.__setattr__(self, "covariance_px2", frozen(self.covariance_px2, (count, 2, 2), "covariance_px2"))

    def __len__(self) -> int:
        return len(self.points_uv)

    def with_more(self, other: Proposals) -> Proposals:
        """Return these proposals, then the other ones."""
        return Proposals(
            np.concatenate([self.points_uv, other.points_uv]),
            np.concatenate([self.probability, other.probability]),
            np.concatenate([self.covariance_px2, other.covariance_px2]),
        )

    def where(self, kept: BoolArray) -> Proposals:
        """Return the proposals for which ``kept`` (n,) has True."""
        return Proposals(self.points_uv[kept], self.probability[kept], self.covariance_px2[kept])

    @property
    def variance_px2(self) -> Array:
        """Mean variance of a coordinate, (n,) pixels squared."""
        variance: Array = 0.5 * (self.covariance_px2[:, 0, 0] + self.covariance_px2[:, 1, 1])
        return variance


@dataclass(frozen=True, slots=True, eq=False)
class Likeness:
    """How much each place of an image looks like an electrode, for the search of a catheter that was seen before.

    values : (rows, columns) float32; about 0 where nothing is, 12 for a clear electrode. cell_px : pixels of the frame from
    value to value. first_px : where the first value lies in the frame, u and v alike.
    """

    values: Image
    cell_px: float
    first_px: float

    def at(self, points_uv: Array) -> Array:
        """Return the values of the cells that points (n, 2) lie in, (n,)."""
        last = np.array(self.values.shape[::-1]) - 1
        cells = np.clip(np.rint((points_uv - self.first_px) / self.cell_px), 0, last).astype(np.int64)
        values: Array = self.values[cells[:, 1], cells[:, 0]].astype(np.float64)
        return values


class ImageEvidence(Protocol):
    """What a proposer knows about one log image."""

    @property
    def smooth(self) -> Image:
        """The log image without most of its noise, ``reduction`` times smaller: shafts are looked for in it."""

    @property
    def reduction(self) -> int: ...

    @property
    def pixel_noise(self) -> float:
        """Standard deviation of a pixel of the log image at its ``reduction``, from noise: shafts are judged by it."""

    @property
    def position_noise(self) -> float:
        """Standard deviation of a pixel of the log image at half its size, from what displaces electrodes: noise and structures."""

    @property
    def likeness(self) -> Likeness: ...

    def proposals(self, allowed: BoolArray, expected: int) -> Proposals:
        """Return the electrodes where ``allowed`` (rows, columns).

        Electrodes much weaker than the ``expected``-th best may be left out.
        """

    def halves_of_pairs(self, allowed: BoolArray) -> Proposals:
        """Return both electrodes of pairs that were proposed as one.

        They lie where ``allowed``.
        """

    def tip_logits_at(self, points_uv: Array) -> Array:
        """Return the log-odds that electrodes at points are tips, (n,).

        It is 0 from a proposer that cannot see it.
        """

    def probability_at(self, points_uv: Array) -> Array:
        """Return the probability that electrodes are at points, (n,)."""

    def kind_odds_at(self, points_uv: Array) -> Array:
        """Return the log-odds by which electrodes differ from other blobs, (n,)."""

    def unseen_probability_at(self, points_uv: Array) -> Array:
        """Return the probability of electrodes that were not proposed, (n,).

        It is 0 where an electrode would have the place of a proposed one.
        """

    def variance_at(self, points_uv: Array) -> Array:
        """Return the variance of each coordinate, (n,) pixels squared.

        It is that of electrodes that are proposed at these points.
        """

    def scores_at(self, points_uv: Array) -> Array:
        """Return how clearly the electrodes of one chain show, (n,).

        It is the proposer's own measure: ``Chain.scores``.
        """


def shaft_image_of(seen: ImageEvidence, px_per_mm: float) -> ShaftImage:
    """Return the image in which the shafts of a log image are looked for."""
    clear = max(_LEAST_LINE, _LINE_NOISE * seen.pixel_noise)
    return ShaftImage(seen.smooth, seen.reduction, clear, px_per_mm)


Proposer = Callable[[Image], ImageEvidence]
"""Looks at one log image, (rows, columns) float32."""


def answers_for_each(ask: Callable[[Array], Array], places: Sequence[Array]) -> list[Array]:
    """Ask about several sets of places at once.

    Each set is (n, 2). Returns the answers of each set, (n,).
    """
    if not places:
        return []
    answers = ask(np.concatenate(places))
    ends = accumulate(len(points) for points in places)
    return [answers[end - len(points) : end] for points, end in zip(places, ends, strict=True)]


_EVEN_CONTRAST = 4.0


def probability_of_contrast(contrast_over_noise: Array) -> Array:
    """Return the probability of an electrode by its contrast alone.

    Its odds are the contrast over 4 sigma.
    """
    contrast = np.maximum(contrast_over_noise, 1e-3)
    probability: Array = contrast / (contrast + _EVEN_CONTRAST)
    return probability


def log_odds(probability: Array) -> Array:
    """Return ln(p / (1 - p)) of probabilities, finite for 0 and 1."""
    inside = np.minimum(np.maximum(probability, 1e-9), 1.0 - 1e-9)
    odds: Array = np.log(inside / (1.0 - inside))
    return odds
