import numpy as np
import pytest

from fluoromap.triangulator.study_equations import HEART_SCALES, SiteEquations, information

UNKNOWNS = 5


def site(random, equations, beats, same_beat):
    roots = random.normal(size=(equations, equations))
    return SiteEquations(
        random.normal(size=equations), random.normal(size=(equations, UNKNOWNS)), roots @ roots.T + np.eye(equations),
        random.normal(size=(equations, 3)), random.normal(size=(equations, beats)), np.zeros((equations, 3)), equations,
        np.ones(equations), same_beat,
    )  # fmt: skip


def test_the_information_of_every_heart_is_that_of_its_whole_covariance():
    """By the inversion of each site's covariance in each heart, which the matrix inversion lemma avoids."""
    random = np.random.default_rng(5)
    rows = [site(random, *shape) for shape in ((9, 6, True), (9, 6, False), (9, 6, False), (4, 6, True), (7, 9, False))]
    at, known = random.normal(size=UNKNOWNS), random.normal(size=len(HEART_SCALES))
    for one, scale, constant in zip(information(rows, at, known), HEART_SCALES, known, strict=True):
        matrix, vector = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
        for row in rows:
            inverse = np.linalg.inv(row.covariance(scale))
            residual = row.residual + row.slope @ at
            matrix += row.slope.T @ inverse @ row.slope
            vector += row.slope.T @ inverse @ residual
            constant -= 0.5 * (residual @ inverse @ residual + np.linalg.slogdet(row.covariance(scale))[1])
        assert one.scale is scale
        np.testing.assert_allclose(one.matrix, matrix, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.vector, vector, rtol=1e-9, atol=1e-9)
        assert one.constant == pytest.approx(constant, rel=1e-9)
