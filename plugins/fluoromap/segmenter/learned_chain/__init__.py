"""Segmenter ``learned-chain``: a small network proposes electrodes, the shared machinery makes chains of them."""
