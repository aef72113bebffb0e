"""Located sites joined with their activation times."""

import numpy as np

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import ElectrodePoint, LocatedSite, Triangulation
from fluoromap.fuser.mapped_sites import mapped_sites
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.reasons import Reason

LATERAL, FRONTAL = (
    camera_from_gantry(Gantry(angle, 0.0, 1000.0, 500.0, (0.35, 0.35), 512, 512)) for angle in (90.0, 0.0)
)
TIP = np.array([20.0, -10.0, 30.0])


def located(name: str, reference: np.ndarray | None) -> LocatedSite:
    relative = None if reference is None else TIP - reference
    covariance = None if reference is None else 0.1 * np.eye(3)
    tip = ElectrodePoint("mapping", 1, TIP, 0.5 * np.eye(3), relative, covariance, (0.1, 0.1), 90.0)
    return LocatedSite(name, LATERAL, FRONTAL, 0, 0, (tip,), reference, None)


def test_a_borrowed_reference_is_reported_and_widens_the_covariance() -> None:
    references = [np.array([1.0, 2.0, 3.0]), np.array([3.0, 2.0, 5.0]), None]
    sites = tuple(located(f"S{k}", at) for k, at in enumerate(references))
    times = {site.site: (10.0, 2.0) for site in sites}
    own, other, borrowed = mapped_sites(Triangulation(sites, ()), DEFAULT_CATALOGUE, times)
    assert own.reasons == other.reasons == ()
    assert borrowed.reasons == (Reason.NO_REFERENCE,)
    np.testing.assert_allclose(borrowed.tip_mm, TIP - [2.0, 2.0, 4.0])
    np.testing.assert_allclose(borrowed.covariance_mm2, 0.5 * np.eye(3) + np.cov(np.array(references[:2]).T))
