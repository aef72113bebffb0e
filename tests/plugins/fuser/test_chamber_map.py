"""Bad input, outliers and the cycle of a re-entry, for every fuser."""

import numpy as np
import pytest
from chambers import directions, fused, sites_at, smooth, sphere, wave
from pydantic import ValidationError

from fluoromap.contracts import MappedSite, Refusal
from fluoromap.drawing.isochrones import isochrones
from fluoromap.fuser.chamber_map import MapParams
from fluoromap.reasons import Reason

FUSERS = pytest.mark.parametrize("fuse", [fused, smooth], ids=["hull", "smooth"])
TETRAHEDRON = np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]])


def still(tips):
    return tuple(
        MappedSite(f"S{index}", tip, np.eye(3), np.array([0, 0, 1.0]), 4.0, 0.0, 1.0) for index, tip in enumerate(tips)
    )


@FUSERS
@pytest.mark.parametrize(
    ("tips", "reason"),
    [
        (TETRAHEDRON[:3], Reason.TOO_FEW_SITES),
        (np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [30, 30, 0]]), Reason.SITES_COPLANAR),
        (np.column_stack([20 * directions(12)[:, :2], np.zeros(12)]), Reason.SITES_COPLANAR),
        (np.outer(np.arange(6.0), [1, 2, 3]), Reason.SITES_COPLANAR),
        (np.column_stack([20 * directions(12)[:, :2], 0.1 * np.arange(12) % 0.3]), Reason.SITES_COPLANAR),
        (np.tile([1.0, 2, 3], (5, 1)), Reason.SITES_COINCIDE),
        (0.8 * directions(9), Reason.SITES_COINCIDE),
    ],
    ids=["three", "four in a plane", "plane", "line", "nearly a plane", "point", "nearly a point"],
)
def test_sites_without_volume_are_refused(fuse, tips, reason):
    with pytest.raises(Refusal) as refusal:
        fuse(still(tips))
    assert refusal.value.reason is reason


@FUSERS
def test_equal_times_are_reported(fuse):
    tips = np.array([site.tip_mm for site in sphere(20)])
    chamber = fuse(sites_at(tips, np.full(20, 12.0)), edge_mm=6)
    assert chamber.warnings == (Reason.TIMES_EQUAL,)
    assert chamber.conduction_velocity is None
    assert np.abs(chamber.lat_ms[chamber.covered] - 12).max() < 0.1


@FUSERS
@pytest.mark.parametrize("count", [4, 6, 20])
def test_half_a_second_off_is_kept_out_at_any_number_of_sites(fuse, count):
    tips = 25 * directions(count)
    times = tips[:, 2].copy()
    times[2] += 500
    chamber = fuse(sites_at(tips, times), edge_mm=6)
    assert [site.site for site in chamber.sites if Reason.LAT_OUTLIER in site.reasons] == ["S03"]
    assert len(chamber.sites) == count
    assert chamber.warnings == (Reason.LAT_OUTLIER,)
    assert chamber.lat_ms.max() < 100
    assert chamber.total_activation_time_ms < 60


@FUSERS
def test_no_site_is_lost_to_noise(fuse):
    sites, _ = wave(20, 3)
    rng = np.random.default_rng(0)
    tips = np.array([site.tip_mm for site in sites]) + 2 * rng.normal(size=(20, 3))
    chamber = fuse(sites_at(tips, np.array([site.lat_ms for site in sites])), edge_mm=6)
    assert [site.site for site in chamber.sites] == [site.site for site in sites]
    for site in chamber.sites:
        assert site.distance_mm == pytest.approx(np.linalg.norm(site.surface_mm - site.position_mm), abs=1e-9)


def test_conduction_velocity_is_reported_where_sites_lie_close():
    sites, _ = wave(150, 1)
    assert smooth(sites, edge_mm=6).conduction_velocity is not None
    assert smooth(sites_at(*_sparse()), edge_mm=6).conduction_velocity is None


def _sparse():
    tips = 35 * directions(12)
    return tips, tips[:, 2]


class TestCycle:
    """Return a wave that circles the Z axis of a sphere in 200 ms, without end."""

    LENGTH = 200.0

    def around(self, count=60, start=-100.0):
        unit = directions(count)
        turn = np.arctan2(unit[:, 1], unit[:, 0]) / (2 * np.pi) * self.LENGTH
        return sites_at(25 * unit, start + np.mod(turn - start, self.LENGTH))

    def test_window_needs_a_cycle(self):
        with pytest.raises(ValidationError, match="cycle_length_ms"):
            MapParams(window_start_ms=0.0)

    def test_early_meets_late_without_a_false_time_between(self):
        chamber = smooth(self.around(), cycle_length_ms=self.LENGTH, edge_mm=4)
        x, y, z = chamber.vertices_mm.T
        equator = np.abs(z) < 15
        turn = np.arctan2(y, x) / (2 * np.pi) * self.LENGTH
        error = np.mod(chamber.lat_ms - turn + 100, 200) - 100
        assert np.abs(error[equator]).max() < 12
        assert chamber.cycle_length_ms == self.LENGTH
        assert chamber.warnings == ()
        assert chamber.lat_ms.min() >= -100
        assert chamber.lat_ms.max() < 100
        assert chamber.leave_one_out_rms_ms < 30

    def test_lines_do_not_crowd_where_early_meets_late(self):
        chamber = smooth(self.around(), cycle_length_ms=self.LENGTH, edge_mm=4)
        ends = []
        for line in isochrones(chamber, np.array([-60.0, 0.0, 60.0])):
            x, y, z = line.points_mm.T
            belt = np.abs(z) < 12
            turn = np.arctan2(y, x)[belt] / (2 * np.pi) * self.LENGTH
            assert np.abs(np.mod(turn - line.lat_ms + 100, 200) - 100).max(initial=0) < 12
            ends.append(belt.any())
        assert sum(ends) >= 3

    def test_times_outside_the_window_are_moved_in_and_reported(self):
        inside = self.around()
        moved = tuple(
            MappedSite(s.site, s.tip_mm, s.covariance_mm2, s.axis, 4.0, s.lat_ms + (400 if k == 5 else 0), s.lat_sd_ms)
            for k, s in enumerate(inside)
        )
        plain = smooth(inside, cycle_length_ms=self.LENGTH, edge_mm=6)
        chamber = smooth(moved, cycle_length_ms=self.LENGTH, edge_mm=6)
        assert chamber.warnings == (Reason.OUTSIDE_WINDOW,)
        assert [site.site for site in chamber.sites if site.reasons] == ["S06"]
        assert chamber.sites[5].lat_ms == pytest.approx(inside[5].lat_ms)
        np.testing.assert_allclose(chamber.lat_ms, plain.lat_ms, atol=1e-6)

    def test_window_start_moves_the_window_only(self):
        early = smooth(self.around(), cycle_length_ms=self.LENGTH, window_start_ms=-100.0, edge_mm=6)
        late = smooth(self.around(), cycle_length_ms=self.LENGTH, window_start_ms=20.0, edge_mm=6)
        assert late.lat_ms[late.covered].min() >= 20
        apart = np.mod(late.lat_ms - early.lat_ms + 100, 200) - 100
        assert np.abs(apart).max() < 1e-6

    def test_a_wrong_time_is_still_found(self):
        sites = list(self.around())
        wrong = sites[30]
        sites[30] = MappedSite(
            wrong.site, wrong.tip_mm, wrong.covariance_mm2, wrong.axis, 4.0, wrong.lat_ms + 90, wrong.lat_sd_ms
        )
        chamber = smooth(tuple(sites), cycle_length_ms=self.LENGTH, edge_mm=6)
        assert [site.site for site in chamber.sites if Reason.LAT_OUTLIER in site.reasons] == [wrong.site]
