"""Chains of the electrodes that network and blobs find."""

from __future__ import annotations

import math
from dataclasses import replace

from fluoromap.catheters import Catalogue
from fluoromap.contracts import PixelFacts
from fluoromap.segmenter.chains.linking import Trust
from fluoromap.segmenter.electrodes.blob_response import BlobResponse
from fluoromap.segmenter.electrodes.frame_answers import LatestBlobs, LatestNetwork, StoredAnswers
from fluoromap.segmenter.electrodes.joint_evidence import FAINT_LOG_ODDS, JointEvidence
from fluoromap.segmenter.electrodes.network.nearby_network import NearbyNetwork
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.network.orientations import ALL_ORIENTATIONS
from fluoromap.segmenter.electrodes.network.weights import Trained
from fluoromap.segmenter.frames.chain_detector import ChainDetector
from fluoromap.segmenter.frames.frame_search import SHARED_MS, FrameSearch, near_distance_mm
from fluoromap.segmenter.judge.acceptance import Acceptance, ScoreLimits
from fluoromap.segmenter.judge.features.dark_lines import IN_FRAME
from fluoromap.segmenter.picture.field_mask import FieldMask
from fluoromap.segmenter.picture.log_image import Image

IN_A_RUN = Acceptance(
    least_clearness=0.1,
    again_clearness=0.1,
    sure_clearness=0.1,
    extra_clearness=0.3,
    scores=ScoreLimits(0.4, seen=0.15, least_seen=0.85),
    unseen_evidence=-0.9,
    strict=True,
    row_chain_score=2.0,
    row_score=0.2,
    hidden_pair=ScoreLimits(0.7, seen=0.15, least_seen=0.75),
    trust=Trust(share=0.25, chain=0.7),
    # Half of the least that an electrode adds to the value of a set of chains: it may be there and hidden.
    faded_price=0.75,
    # The mean along the track decides about what single frames leave open.
    dark_lines=replace(IN_FRAME, sure=0.3),
)
ALONE = replace(
    IN_A_RUN,
    scores=ScoreLimits(0.5, seen=0.2, least_seen=0.85),
    scores_beside=ScoreLimits(0.4, seen=0.15, least_seen=0.7),
    faded_price=math.inf,
    hidden_pair=ScoreLimits(math.inf),
    dark_lines=IN_FRAME,
)
"""Scores are probabilities. In a single frame no other frame confirms a chain, but another catheter does."""

_COARSE_BITS = 8
_COARSE_NOISE = 0.004


def electrode_chains(
    catalogue: Catalogue,
    field: FieldMask,
    pixels: PixelFacts,
    px_per_mm: float,
    trained: Trained,
    alone: bool,
    frame_ms: float = math.inf,
    answers: StoredAnswers | None = None,
) -> FrameSearch:
    """Return the detector of one run.

    It finds electrodes by network and blobs, and the chains of them. ``alone`` : no other frame confirms a chain. ``frame_ms`` :
    longest time between frames. ``answers`` : those of network and blobs for frames of this run that earlier detectors stored.
    """
    ring_mm = min(catheter.ring_mm for catheter in catalogue.catheters)
    least_noise = _COARSE_NOISE if pixels.bits_stored <= _COARSE_BITS else 0.0

    orientations = ALL_ORIENTATIONS if alone else 1
    network = LatestNetwork(
        lambda x: NetworkResponse.of_image(x, trained, px_per_mm, orientations),
        lambda x: NearbyNetwork(x, trained, px_per_mm),
    )
    blobs = LatestBlobs(lambda x: BlobResponse.of_image(x, field.inside, ring_mm, px_per_mm))

    def ask(x: Image) -> JointEvidence:
        faint = 0.0 if alone else FAINT_LOG_ODDS
        return JointEvidence(network(x), blobs(x), px_per_mm, least_noise, faint, network.reach_cells)

    detector = ChainDetector(catalogue, field, px_per_mm, ask, ALONE if alone else IN_A_RUN)
    near_px = near_distance_mm(frame_ms) * px_per_mm
    stored = StoredAnswers() if answers is None else answers
    return FrameSearch(detector, network, blobs, len(catalogue.catheters), frame_ms <= SHARED_MS, near_px, stored)
