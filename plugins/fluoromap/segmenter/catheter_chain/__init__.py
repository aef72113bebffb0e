"""Segmenter ``catheter-chain``: blobs linked to chains that fit a catheter."""
