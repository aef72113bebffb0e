"""Overlays, views, isochrones and colours: every symbol is drawn at its projected place."""

import io
from dataclasses import replace

import numpy as np
import pytest
from chambers import fused, sites_at, sphere
from PIL import Image, ImageDraw
from scipy.spatial import Delaunay
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOImage import vtkPNGReader

from fluoromap.drawing.animation import PICTURES, draw_propagation
from fluoromap.drawing.colour_bar import bar_box
from fluoromap.drawing.colours import Scale, colour_map, milliseconds, scale_of, vertex_colours
from fluoromap.drawing.electrodes import CATHETERS_RGB
from fluoromap.drawing.isochrones import isochrones
from fluoromap.drawing.lettering import PHRASE_GAP, _masks, font
from fluoromap.drawing.map_picture import draw_map_views
from fluoromap.drawing.overlay import Look, draw_overlay
from fluoromap.drawing.png import encode_png
from fluoromap.drawing.raster import rasterise
from fluoromap.drawing.wall import HATCH, NO_DATA, NOTHING, outline_edges, pixel_bands
from fluoromap.drawing.warm_up import warm_up
from fluoromap.fuser.surface import face_normals
from fluoromap.geometry import Camera, Gantry, camera_from_gantry

SHIFT = np.array([-10.0, 20.0, -5.0])


def camera(primary: float = 90.0, secondary: float = 0.0, rows: int = 512, columns: int = 512) -> Camera:
    spacing = 178 * 2 / 512
    return camera_from_gantry(Gantry(primary, secondary, 1000.0, 500.0, (spacing, spacing), rows, columns))


def grey(view: Camera) -> np.ndarray:
    return np.full((view.rows, view.columns), 120, dtype=np.uint8)


class TestIsochrones:
    def test_points_lie_on_their_level(self, ball):
        lines = isochrones(ball, np.arange(-20.0, 25.0, 5.0))
        assert {line.lat_ms for line in lines} == set(np.arange(-20.0, 25.0, 5.0))
        for line in lines:
            assert len(line.faces) == len(line.points_mm) - 1
            # The field is linear in X to within the map's error.
            assert np.abs(line.points_mm[:, 0] - 10 - line.lat_ms).max() < 2.5

    def test_lines_on_a_closed_covered_surface_are_closed(self, ball):
        for line in isochrones(ball, np.arange(-20.0, 25.0, 5.0)):
            np.testing.assert_array_equal(line.points_mm[0], line.points_mm[-1])

    def test_a_level_through_a_vertex_breaks_nothing(self, ball):
        (level,) = ball.lat_ms[[17]]
        lines = isochrones(ball, np.array([level]))
        assert all((line.points_mm[0] == line.points_mm[-1]).all() for line in lines)

    def test_each_segment_lies_in_its_face(self, ball):
        for line in isochrones(ball, np.arange(-20.0, 25.0, 5.0)):
            corners = ball.vertices_mm[ball.faces[line.faces]]
            for ends in (line.points_mm[:-1], line.points_mm[1:]):
                # On one of the face's edges: the way over two corners is as long as the edge.
                to_corner = np.linalg.norm(corners - ends[:, None], axis=2)
                edge = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
                assert ((to_corner + np.roll(to_corner, -1, axis=1) - edge).min(axis=1) < 1e-9).all()

    def test_a_surface_whose_faces_meet_in_threes_is_drawn(self, ball):
        fin = np.vstack(
            [ball.faces, [[*ball.faces[5][:2], ball.faces[-1][0]]], [[*ball.faces[9][:2], ball.faces[5][2]]]]
        )
        joined = replace(ball, faces=fin)
        for level in np.arange(-20.0, 20.0, 0.25):
            segments = sum(len(line.faces) for line in isochrones(joined, np.array([level])))
            later = joined.lat_ms >= level
            assert segments == (np.ptp(later[fin].astype(int), axis=1) > 0).sum()

    def test_no_line_runs_through_uncovered_faces(self, sparse_ball):
        for line in isochrones(sparse_ball, np.arange(-20.0, 25.0, 5.0)):
            assert sparse_ball.covered[sparse_ball.faces[line.faces]].all()


class TestColours:
    @pytest.mark.parametrize(("spread", "step"), [(2, 5), (48, 5), (90, 10), (110, 10), (220, 20)])
    def test_step_follows_the_range(self, spread, step):
        sites = sphere(20, slope_ms_per_mm=spread / 50)
        scale = scale_of(fused(sites, edge_mm=7))
        assert scale.step_ms == step
        assert scale.start_ms % step == 0
        assert all(scale.start_ms <= site.lat_ms <= scale.stop_ms for site in sites)

    def test_order_survives_without_hue(self):
        colours = colour_map(np.linspace(0, 1, 30)).astype(float)
        linear = np.where(colours / 255 <= 0.04045, colours / 255 / 12.92, ((colours / 255 + 0.055) / 1.055) ** 2.4)
        assert (np.diff(linear @ [0.2126, 0.7152, 0.0722]) < 0).all()
        # Machado, Oliveira & Fernandes (2009), complete deuteranopia: such a reader sees the same order.
        deuteranope = linear @ np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                                         [-0.011820, 0.042940, 0.968881]]).T  # fmt: skip
        assert (np.diff(deuteranope @ [0.2126, 0.7152, 0.0722]) < 0).all()

    def test_red_early_begins_red_and_ends_violet(self):
        first, middle, last = colour_map(np.array([0.0, 0.5, 1.0]), "red-early").astype(int)
        assert first[0] > 2 * max(first[1:])
        assert middle[1] > middle[0]
        assert last[2] > last[0] > last[1]

    def test_a_given_step_is_kept(self, ball):
        assert [scale_of(ball, step).step_ms for step in (5.0, 10.0)] == [5.0, 10.0]

    def test_no_data_is_grey_and_no_band_is(self, sparse_ball):
        colours = vertex_colours(sparse_ball).astype(int)
        assert (np.ptp(colours[~sparse_ball.covered], axis=1) == 0).all()
        assert np.ptp(scale_of(sparse_ball).band_colours().astype(int), axis=1).min() > 60

    def test_bands(self):
        scale = Scale(-10.0, 5.0, 4)
        assert scale.band(np.array([-99, -10, -5.01, -5, 9.9, 99])).tolist() == [0, 0, 0, 1, 3, 3]
        assert [milliseconds(value) for value in (-0.4, -12.6, 41.2)] == ["0", "-13", "41"]


def test_raster_shows_the_nearest_face_with_linear_values():
    uv = np.array([[0, 0], [40, 0], [0, 40], [0, 0], [40, 0], [0, 40]], dtype=float)
    nearness = np.array([1.0, 1, 1, 5, 5, 5])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    for order in (faces, faces[::-1]):
        raster = rasterise(uv, nearness, order, np.ones(2, dtype=bool), (50, 50))
        shown = np.flatnonzero(raster.face >= 0)
        v, u = np.divmod(shown, 50)
        assert (order[raster.face[v, u]] == [3, 4, 5]).all()
        np.testing.assert_allclose(raster.sample(shown, 2 * uv[:, 0] - uv[:, 1]), 2.0 * u - v, atol=1e-9)
    assert raster.visible(np.array([[5.0, 5.0], [5.0, 5.0], [45.0, 45.0]]), np.array([5.0, 1.0, 1.0])).tolist() == [
        True,
        False,
        True,
    ]


@pytest.mark.parametrize("seed", range(3))
def test_faces_side_by_side_share_no_pixel_and_miss_none(seed):
    rng = np.random.default_rng(seed)
    # Beyond the picture on all sides; some corners exactly on pixel centres.
    uv = np.concatenate([rng.uniform(-30, 110, (150, 2)), rng.integers(-5, 85, (50, 2))])
    uv = np.unique(np.concatenate([uv, [[-99, -99], [199, -99], [-99, 199], [199, 199]]]), axis=0)
    faces = Delaunay(uv).simplices
    painted = np.zeros((60, 80), dtype=int)
    for one in range(len(faces)):
        alone = rasterise(uv, np.ones(len(uv)), faces, np.arange(len(faces)) == one, (60, 80)).face
        assert set(np.unique(alone)) <= {-1, one}
        painted += alone >= 0
    assert (painted == 1).all()
    together = rasterise(uv, np.ones(len(uv)), faces, np.ones(len(faces), bool), (60, 80)).face
    v, u = np.mgrid[:60, :80]
    corners = uv[faces[together]]
    edges = np.roll(corners, -1, axis=2) - corners
    to_pixel = np.stack([u, v], axis=2)[:, :, None] - corners
    side = edges[..., 0] * to_pixel[..., 1] - edges[..., 1] * to_pixel[..., 0]
    assert ((side >= -1e-6).all(axis=2) | (side <= 1e-6).all(axis=2)).all()


@pytest.mark.parametrize(("across", "down"), [(0, 0), (-250, 0), (0, 230), (-230, -240), (600, 0), (0, -600)])
def test_a_map_partly_or_wholly_outside_the_picture_is_the_same_map(sparse_ball, across, down):
    uv = 250 + 4 * sparse_ball.vertices_mm[:, :2] + 700.0
    facing, times = np.ones(len(sparse_ball.faces), bool), scale_of(sparse_ball)

    def drawn(shift, side):
        raster = rasterise(uv + shift, sparse_ball.vertices_mm[:, 2], sparse_ball.faces, facing, (side, side))
        shown = pixel_bands(raster, sparse_ball, times, 1.0)
        outside = np.ones((side, side), bool)
        outside[raster.box] = False
        assert (raster.face[outside] == -1).all()
        assert (shown[outside] == NOTHING).all()
        return raster.face, np.where(shown == HATCH, NO_DATA, shown)

    whole = drawn(np.zeros(2), 1900)
    shift = np.array([across, down])
    part = drawn(shift - 700.0, 500)
    left, upper = 700 - shift
    for of_whole, of_part in zip(whole, part, strict=True):
        # Rounding of the shifted coordinates may move single pixels on an edge.
        assert (of_whole[upper : upper + 500, left : left + 500] != of_part).mean() < 1e-4


def test_the_outline_lies_between_faces_that_face_the_viewer_and_others(ball):
    facing = face_normals(ball.vertices_mm, ball.faces)[:, 2] > 0
    faces_of = {}
    for face, corners in enumerate(ball.faces.tolist()):
        for edge in zip(corners, corners[1:] + corners[:1], strict=True):
            faces_of.setdefault(tuple(sorted(edge)), []).append(facing[face])
    wanted = sorted(edge for edge, sides in faces_of.items() if sum(sides) == 1)
    assert [tuple(edge) for edge in outline_edges(ball.faces, facing).tolist()] == wanted


def _bands_pixel_by_pixel(raster, chamber, times, until):
    """Return the content of every pixel by its own time.

    -9 where a vertex past the covered part takes part.
    """
    pixels = np.flatnonzero(raster.face >= 0)
    lat = raster.sample(pixels, chamber.lat_ms, chamber.cycle_length_ms)
    wanted = np.full(raster.face.size, NOTHING)
    wanted[pixels] = times.band(lat) if until is None else np.where(lat <= until, times.band(lat), NOTHING)
    known = chamber.covered[chamber.faces].all(axis=1)[raster.face.ravel()[pixels]]
    wanted[pixels[~known]] = -9
    wanted[pixels[raster.sample(pixels, chamber.covered.astype(float)) <= 0.5]] = NO_DATA
    return wanted


def _same_where_known(shown, wanted):
    got = np.where(shown == HATCH, NO_DATA, shown).ravel()
    np.testing.assert_array_equal(got[wanted != -9], wanted[wanted != -9])
    # On the rim the times are the neighbours', but a band there is.
    assert (got[wanted == -9] != NO_DATA).all()


@pytest.mark.parametrize("until", [None, 5.0])
@pytest.mark.parametrize("scale", [1, 3])
def test_each_pixel_shows_the_band_of_its_own_time(ball, sparse_ball, until, scale):
    for chamber in (ball, sparse_ball):
        uv = (250 + 4 * chamber.vertices_mm[:, :2]) * scale
        facing = np.ones(len(chamber.faces), bool)
        raster = rasterise(uv, chamber.vertices_mm[:, 2], chamber.faces, facing, (500 * scale, 500 * scale))
        shown = pixel_bands(raster, chamber, scale_of(chamber), 1.0, until)
        _same_where_known(shown, _bands_pixel_by_pixel(raster, chamber, scale_of(chamber), until))


@pytest.mark.parametrize("until", [None, 100.0, 200.0])
@pytest.mark.parametrize(
    # The second band of the last scale contains all later times, on both sides of the closing of the cycle.
    "times", [Scale(0.0, 20.0, 18), Scale(0.0, 360.0, 1), Scale(0.0, 0.01, 36000), Scale(0.0, 2.0, 2)]
)  # fmt: skip
def test_each_pixel_of_a_reentry_shows_the_band_of_its_own_time(until, times):
    reentry, uv = circling(360.0)
    raster = rasterise(uv, reentry.vertices_mm[:, 2], reentry.faces, np.ones(len(reentry.faces), bool), (500, 500))
    shown = pixel_bands(raster, reentry, times, 1.0, until)
    _same_where_known(shown, _bands_pixel_by_pixel(raster, reentry, times, until))
    # Times later by whole cycles give the same bands.
    later = replace(reentry, lat_ms=reentry.lat_ms + 360.0 * (np.arange(len(uv)) % 3 == 0) * (uv[:, 0] > 250))
    # Where the cycle closes a rounding error decides.
    assert (pixel_bands(raster, later, times, 1.0, until) != shown).mean() < 5e-4


def test_the_rim_takes_the_times_of_its_neighbours(sparse_ball):
    raster = rasterise(
        250 + 4 * sparse_ball.vertices_mm[:, :2], sparse_ball.vertices_mm[:, 2], sparse_ball.faces,
        np.ones(len(sparse_ball.faces), bool), (500, 500),
    )  # fmt: skip
    late = replace(sparse_ball, lat_ms=np.where(sparse_ball.covered, 100.0, 0.0))
    shown = pixel_bands(raster, late, Scale(0.0, 5.0, 30), 1.0)
    assert set(np.unique(shown)) == {NOTHING, HATCH, NO_DATA, 20}


def circling(cycle):
    """Return a re-entry whose times go round once.

    Also return its vertices along the axis of the circuit: each its own angle.
    """
    chamber = fused(sphere(20, slope_ms_per_mm=1.0), edge_mm=4)
    middle = chamber.vertices_mm.mean(axis=0)
    turn = np.degrees(np.arctan2(*(chamber.vertices_mm - middle)[:, [1, 0]].T)) % 360 * cycle / 360
    reentry = replace(chamber, lat_ms=turn, cycle_length_ms=cycle, covered=np.ones(len(turn), bool))
    return reentry, 250 + 5 * (chamber.vertices_mm - middle)[:, :2]


def test_early_meets_late_without_running_through_all_bands():
    cycle = 360.0
    reentry, uv = circling(cycle)
    facing = np.ones(len(reentry.faces), bool)
    raster = rasterise(uv, reentry.vertices_mm[:, 2], reentry.faces, facing, (500, 500))
    shown = np.flatnonzero(raster.face >= 0)
    v, u = np.divmod(shown, 500)
    sampled = raster.sample(shown, reentry.lat_ms, cycle)
    angle = np.degrees(np.arctan2(v - 250, u - 250)) % 360
    off = np.abs((sampled - angle + 180) % 360 - 180)
    away = np.hypot(v - 250, u - 250) > 50
    # Every pixel but those at its centre shows its own angle.
    assert off[away].max() < 25
    assert ((sampled >= reentry.lat_ms.min()) & (sampled < reentry.lat_ms.min() + cycle)).all()


@pytest.mark.parametrize("size", [9, 11, 12, 15, 24, 36])
@pytest.mark.parametrize("site", ["S03", "17 b", "Sitio Ñ", "RVOT-12_x"])
@pytest.mark.parametrize("direction", ["AP", "LAO 45 CRA 20", "RAO 7 CAU 3"])
def test_a_caption_of_phrases_is_the_caption_in_one_piece(size, site, direction):
    text = PHRASE_GAP.join([site, direction, "simulated data, for research"])
    for mask, rim in zip(_masks(text, size), (0, max(1, size // 9)), strict=True):
        one_piece = Image.new("L", mask.size)
        middle = mask.width // 2, mask.height // 2
        ImageDraw.Draw(one_piece).text(middle, text, fill=255, font=font(size), anchor="mm", stroke_width=rim)
        np.testing.assert_array_equal(np.asarray(mask), np.asarray(one_piece))


def test_the_first_picture_of_a_process_can_be_drawn_ahead():
    warm_up()


class TestOverlay:
    @pytest.mark.parametrize("scale", [1, 2])
    def test_size_and_kind(self, ball, scale):
        view = camera(rows=400, columns=512)
        picture = draw_overlay(grey(view), view, ball, SHIFT, "S05", None, Look(scale=scale))
        assert picture.shape == (400 * scale, 512 * scale, 3)
        assert picture.dtype == np.uint8

    @pytest.mark.parametrize("scale", [1, 2])
    @pytest.mark.parametrize(("primary", "secondary"), [(90, 0), (-30, 20)])
    def test_star_is_at_the_projected_tip(self, ball, primary, secondary, scale):
        view = camera(primary, secondary)
        site = next(site for site in ball.sites if site.site == "S05")
        tip = (view.project(site.position_mm + SHIFT) + 0.5) * scale - 0.5
        picture = draw_overlay(grey(view), view, ball, SHIFT, "S05", None, Look(scale=scale))
        white = (picture == 255).all(axis=2)
        v, u = np.nonzero(white)
        pixels = np.stack([u, v], axis=1)
        star = pixels[np.linalg.norm(pixels - tip, axis=1) < 5 * scale]
        assert len(star) > 20 * scale
        assert np.linalg.norm(star.mean(axis=0) - tip) <= scale

    def test_ellipse_is_the_projected_covariance(self, ball):
        view = camera()
        site = next(site for site in ball.sites if site.site == "S05")
        # A lateral view looks along X; Z is up.
        tall = {"S05": np.diag([1.0, 1.0, 9.0])}
        black = np.zeros((512, 512), np.uint8)
        plain = draw_overlay(black, view, ball, SHIFT, "none", None).astype(int)
        drawn = draw_overlay(black, view, ball, SHIFT, "none", None, Look(covariances_mm2=tall)).astype(int)
        v, u = np.nonzero(np.abs(drawn - plain).sum(axis=2) > 60)
        centre = view.project(site.position_mm + SHIFT)
        px_per_mm = np.linalg.norm(view.project(site.position_mm + SHIFT + [0, 0, 1]) - centre)
        reach = np.sqrt(5.9915) * px_per_mm
        assert np.ptp(v) / 2 == pytest.approx(3 * reach, abs=2)
        assert np.ptp(u) / 2 == pytest.approx(reach, abs=2)
        assert (v.max() + v.min()) / 2 == pytest.approx(centre[1], abs=3)

    def test_wall_is_coloured_up_to_the_given_time(self, ball):
        view = camera(0.0)
        early, late = (
            draw_overlay(grey(view), view, ball, SHIFT, "none", None, Look(until_ms=until)).astype(int)
            for until in (-10.0, 10.0)
        )
        everything = draw_overlay(grey(view), view, ball, SHIFT, "none", None).astype(int)

        def coloured(picture):
            return (np.ptp(picture, axis=2) > 12)[:, :440].sum()

        assert 0 < coloured(early) < coloured(late) < coloured(everything)

    def test_propagation_runs_from_the_earliest_to_the_latest(self, ball):
        view = camera(0.0)
        moving = Image.open(io.BytesIO(draw_propagation(grey(view), view, ball, SHIFT, "none", None, Look())))
        assert moving.n_frames == PICTURES
        shares = []
        for index in (1, PICTURES // 2, PICTURES - 1):
            moving.seek(index)
            picture = np.asarray(moving.convert("RGB")).astype(int)
            shares.append((np.ptp(picture, axis=2) > 12)[:, :440].sum())
        assert shares == sorted(set(shares))

    def test_star_takes_the_given_tip(self, ball):
        view = camera()
        tip = np.array([60.0, 380.0])
        with_star = draw_overlay(grey(view), view, ball, SHIFT, "S05", tip)
        white = (with_star == 255).all(axis=2)
        v, u = np.nonzero(white)
        pixels = np.stack([u, v], axis=1)
        star = pixels[np.linalg.norm(pixels - tip, axis=1) < 9]
        assert np.linalg.norm(star.mean(axis=0) - tip) <= 1

    def test_a_ring_lies_around_each_electrode_in_its_catheters_colour(self, ball):
        view = camera()
        electrodes = {"reference": np.array([[40.0, 200.0], [60.0, 230.0]]), "mapping": np.array([[90.0, 420.0]])}
        look = Look(electrodes_uv=electrodes)
        plain = draw_overlay(grey(view), view, ball, SHIFT, "S05", None).astype(int)
        drawn = draw_overlay(grey(view), view, ball, SHIFT, "S05", None, look).astype(int)
        for (_, places), colour in zip(electrodes.items(), CATHETERS_RGB, strict=False):
            for place in places:
                u, v = np.nonzero((drawn == colour).all(axis=2))[::-1]
                ring = np.stack([u, v], axis=1)
                ring = ring[np.linalg.norm(ring - place, axis=1) < 7]
                assert np.linalg.norm(ring.mean(axis=0) - place) < 1
                assert (drawn[int(place[1]), int(place[0])] == plain[int(place[1]), int(place[0])]).all()

    @pytest.mark.parametrize("primary", [0, 90, 45])
    def test_each_dot_is_where_its_site_projects(self, primary):
        tips = np.array([[0.0, 0, 0], [30, 5, 0], [0, 30, 8], [4, 3, 30], [-20, -15, 10]])
        view = camera(primary)
        times = np.array([0.0, 20, 40, 60, 80])
        chamber = fused(sites_at(tips, times), edge_mm=5)
        first = draw_overlay(grey(view), view, chamber, [0, 0, 0], "none", None)
        scale = scale_of(chamber)
        for index, tip in enumerate(tips):
            uv = view.project(tip)
            own = scale.band_colours()[scale.band(times[index])].astype(int)
            v, u = np.nonzero(np.abs(first.astype(int) - own).max(axis=2) < 30)
            pixels = np.stack([u, v], axis=1)
            dot = pixels[np.linalg.norm(pixels - uv, axis=1) < 5]
            assert len(dot) >= 4
            assert np.linalg.norm(dot.mean(axis=0) - uv) <= 1

    def test_front_wall_is_the_one_towards_the_detector(self):
        # Early on the patient's left (+X), late on the right; a left lateral C-arm looks from the left.
        chamber = fused(sphere(60, slope_ms_per_mm=-1.0), edge_mm=5)
        scale = scale_of(chamber)
        for primary, expected in ((90, scale.band_colours()[1]), (-90, scale.band_colours()[-2])):
            view = camera(primary)
            picture = draw_overlay(np.zeros((512, 512), np.uint8), view, chamber, SHIFT, "none", None).astype(float)
            u, v = np.rint(view.project(np.array([10.0, -20.0, 5.0]) + SHIFT)).astype(int)
            patch = np.median(picture[v - 12 : v + 13, u - 12 : u + 13].reshape(-1, 3), axis=0)
            direction = patch / np.linalg.norm(patch)
            wanted = expected / np.linalg.norm(expected.astype(float))
            assert direction @ wanted > 0.97

    def test_isochrones_are_drawn_where_they_project(self, ball):
        # Seen from the front the times, linear in X, make upright lines: the faces towards the viewer alone are crossed.
        view = camera(0.0)
        edges = scale_of(ball).edges_ms[1:-1]
        black = np.zeros((512, 512), np.uint8)
        with_lines = draw_overlay(black, view, ball, SHIFT, "none", None).astype(int).min(axis=2)
        facing = face_normals(ball.vertices_mm, ball.faces)[:, 1] < -0.3
        drawn = []
        for line in isochrones(ball, edges):
            middles = ((line.points_mm[1:] + line.points_mm[:-1]) / 2)[facing[line.faces]]
            for u, v in np.rint(view.project(middles + SHIFT)).astype(int):
                if u < 430:
                    row = with_lines[v, u - 9 : u + 10]
                    drawn.append(row[8:11].max() > np.median(row) + 25)
        # Dots and letters hide some.
        assert len(drawn) > 50
        assert np.mean(drawn) > 0.75

    def test_the_front_of_a_propagation_is_drawn_and_nothing_beyond_it(self, ball):
        view = camera(0.0)
        black = np.zeros((512, 512), np.uint8)
        until = 7.0
        picture = draw_overlay(black, view, ball, SHIFT, "none", None, Look(until_ms=until)).astype(int).min(axis=2)
        middle = ball.vertices_mm.mean(axis=0)
        # The next isochrones would be at 10 and 15 ms.
        for lat, least, most in ((until, 200, 255), (10.0, 0, 40), (15.0, 0, 40)):
            u, v = np.rint(view.project(np.array([10 + lat, *middle[1:]]) + SHIFT)).astype(int)
            strip = picture[v - 20 : v + 21, u - 4 : u + 5]
            assert least <= np.median(strip.max(axis=1)) <= most

    def test_colour_bar_shows_every_band_in_order(self, ball):
        view = camera()
        picture = draw_overlay(grey(view), view, ball, SHIFT, "none", None)
        scale = scale_of(ball)
        left, top, right, bottom = bar_box(scale, (512, 512), 12)
        panel = picture[int(top) : int(bottom), int(left) : int(right)].astype(int)
        rows = [
            np.nonzero((np.abs(panel - colour).max(axis=2) == 0).sum(axis=1) > 5)[0] for colour in scale.band_colours()
        ]
        middles = [row.mean() for row in rows]
        assert (np.diff(middles) > 5).all()

    def test_electrodes_stay_legible_and_the_rest_is_unchanged(self, ball):
        view = camera()
        bright = draw_overlay(np.full((512, 512), 160, np.uint8), view, ball, SHIFT, "none", None).astype(int)
        dark = draw_overlay(np.full((512, 512), 60, np.uint8), view, ball, SHIFT, "none", None).astype(int)
        contrast = (bright - dark).mean(axis=2)
        u, v = np.rint(view.project(np.array([10.0, -20.0, 5.0]) + SHIFT)).astype(int)
        assert np.median(contrast[v - 40 : v + 41, u - 40 : u + 41]) > 0.6 * 100
        assert (bright[:40, :300] == 160).all()

    def test_an_uncovered_wall_gets_no_colour_but_a_hatch(self, sparse_ball):
        view = camera()
        wall = draw_overlay(grey(view), view, replace(sparse_ball, covered=np.zeros_like(sparse_ball.covered)), SHIFT,
                            "none", None, Look(times=scale_of(sparse_ball))).astype(int)  # fmt: skip
        u, v = np.rint(view.project(sparse_ball.vertices_mm.mean(axis=0) + SHIFT)).astype(int)
        patch = wall[v - 60 : v + 61, u - 60 : u + 61]
        patch = patch[np.ptp(patch, axis=2) == 0][:, 0]
        hatched = patch == round(120 + 0.4 * (205 - 120))
        assert 0.08 < hatched.mean() < 0.3
        # Between the lines of the hatch the image is unchanged.
        assert (patch[~hatched] == 120).mean() > 0.9

    def test_unknown_site_far_map_and_wrong_frame(self, ball):
        view = camera()
        assert draw_overlay(grey(view), view, ball, [5000.0, 0, 0], "S99", None).shape == (512, 512, 3)
        assert draw_overlay(grey(view), view, ball, [-600.0, 0, 0], "S05", None).shape == (512, 512, 3)
        with pytest.raises(ValueError, match="frame"):
            draw_overlay(np.zeros((10, 10), np.uint8), view, ball, SHIFT, "S05", None)
        with pytest.raises(ValueError, match="scale"):
            draw_overlay(grey(view), view, ball, SHIFT, "S05", None, Look(scale=0))

    def test_the_same_overlay_has_the_same_bytes(self, ball):
        view = camera()
        picture = draw_overlay(grey(view), view, ball, SHIFT, "S05", None)
        again = draw_overlay(grey(view), view, ball, SHIFT, "S05", None)
        assert encode_png(picture) == encode_png(again)


@pytest.mark.parametrize(
    "picture", [np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 1), np.uint8), np.zeros((4, 4), np.uint16),
                np.zeros((0, 4), np.uint8)],
)  # fmt: skip
def test_only_grey_and_rgb_pictures_become_png(picture):
    with pytest.raises(ValueError, match="picture"):
        encode_png(picture)


@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (200, 301), (1, 5, 3), (64, 65, 3), (840, 841, 3)])
def test_png_is_the_picture(shape, tmp_path):
    rng = np.random.default_rng(3)
    for picture in (rng.integers(0, 256, shape, dtype=np.uint8), np.full(shape, 250, dtype=np.uint8)):
        content = encode_png(picture)
        read = Image.open(io.BytesIO(content))
        assert read.mode == ("L" if len(shape) == 2 else "RGB")
        np.testing.assert_array_equal(np.asarray(read), picture)
        # libpng, which checks every sum; its rows count from the bottom.
        (tmp_path / "picture.png").write_bytes(content)
        reader = vtkPNGReader()
        reader.SetFileName(str(tmp_path / "picture.png"))
        reader.Update()
        scalars = vtk_to_numpy(reader.GetOutput().GetPointData().GetScalars())
        np.testing.assert_array_equal(scalars.reshape(shape)[::-1], picture)


def test_views_show_each_side_in_its_colours():
    chamber = fused(sphere(60, slope_ms_per_mm=-1.0), edge_mm=5)
    picture = draw_map_views(chamber)
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    bands = scale_of(chamber).band_colours().astype(float)
    # Third panel of the first row: from the patient's left, where it is early.
    patch = np.median(picture[160:180, 840:860].reshape(-1, 3).astype(float), axis=0)
    nearest = np.linalg.norm(bands / np.linalg.norm(bands, axis=1)[:, None] - patch / np.linalg.norm(patch), axis=1)
    assert nearest.argmin() <= 1
