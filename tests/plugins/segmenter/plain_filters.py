"""Plain double-precision twins of the compiled filters, sweep by sweep, as the paper's equations read."""

import math

import numpy as np
from scipy import ndimage


def homomorphic(x, low=0.5, high=2.0, slope=1.0, cutoff=8.0, mode="reflect"):
    sigma = x.shape[1] * math.sqrt(slope) / (math.pi * math.sqrt(2) * cutoff)
    blurred = ndimage.gaussian_filter(x.astype(float), sigma, mode=mode, truncate=8.0)
    return high * x - (high - low) * blurred


def perona_malik(x, k, sweeps=15, step=0.2):
    x = x.astype(float)
    for _ in range(sweeps):
        p = np.pad(x, 1, mode="edge")
        differences = (p[:-2, 1:-1] - x, p[2:, 1:-1] - x, p[1:-1, :-2] - x, p[1:-1, 2:] - x)
        x = x + step * sum(d * np.exp(-((d / k) ** 2)) for d in differences)
    return x


def complex_shock(x, sweeps=15, step=0.1, magnitude=0.5, tangential=0.5, theta=math.pi / 1000, feedback=0.5, sign=-1.0):
    value = x.astype(complex)
    lam = magnitude * np.exp(1j * theta)
    for _ in range(sweeps):
        p = np.pad(value, 1, mode="edge")
        c = p[1:-1, 1:-1]
        east, west = (p[1:-1, 2:] - c).real, (c - p[1:-1, :-2]).real
        south, north = (p[2:, 1:-1] - c).real, (c - p[:-2, 1:-1]).real
        steepness = np.hypot(_minmod(east, west), _minmod(south, north))
        gu, gv = 0.5 * (east + west), 0.5 * (south + north)
        uu = p[1:-1, 2:] - 2 * c + p[1:-1, :-2]
        vv = p[2:, 1:-1] - 2 * c + p[:-2, 1:-1]
        uv = 0.25 * (p[2:, 2:] + p[:-2, :-2] - p[2:, :-2] - p[:-2, 2:])
        square = gu**2 + gv**2 + 1e-8
        along = (uu * gu**2 + 2 * uv * gu * gv + vv * gv**2) / square
        across = (uu * gv**2 - 2 * uv * gu * gv + vv * gu**2) / square
        shock = sign * 2 / math.pi * np.arctan(feedback * value.imag / theta) * steepness
        value = value + step * (shock + lam * along + tangential * across)
    return value.real


def _minmod(a, b):
    return np.where(a * b > 0, np.sign(a) * np.minimum(abs(a), abs(b)), 0.0)


def disk(radius):
    v, u = np.ogrid[-radius : radius + 1, -radius : radius + 1]
    return u * u + v * v <= radius * radius


def disk_morphology(x, background, opening):
    def dilate(a, r):
        return ndimage.grey_dilation(a, footprint=disk(r), mode="constant", cval=-np.inf)

    def erode(a, r):
        return ndimage.grey_erosion(a, footprint=disk(r), mode="constant", cval=np.inf)

    hat = erode(dilate(x, background), background) - x
    return dilate(erode(hat, opening), opening)
