"""Chains: candidate electrodes are linked to paths that fit a catheter, completed, and the best set is chosen."""
