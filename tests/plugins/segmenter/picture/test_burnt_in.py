import io

import numpy as np
import pytest
from frame_sources import Frames
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import PixelFacts, Run, Silent
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.segmenter.picture.burnt_in import burnt_in_text
from fluoromap.segmenter.picture.field_mask import find_field

FACTS = PixelFacts(True, 8, False)
LIKE_ELECTRODES = {(60, 60): "ID 0012345", (60, 90): "o o o o", (250, 380): "H H E E F F", (80, 300): "LIH 11.1.19"}
LINES = {(12, 12): "LAO 30 CRAN 12", (300, 400): "F 15/s  74 kV 8 mA", (40, 420): "ID 001234"}


def anatomy(frames, noise=8.0):
    """Return pictures of broad shadows in noise, grey levels of 8 bits."""
    rng = np.random.default_rng(3)
    broad = ndimage.gaussian_filter(rng.normal(size=(512, 512)), 40.0)
    level = 130 + 45 * broad / np.abs(broad).max()
    grain = (ndimage.gaussian_filter(rng.normal(size=(512, 512)), 0.7) for _ in range(frames))
    return [level + noise * one / one.std() for one in grain]


def stored(level, quality=None):
    picture = Image.fromarray(np.clip(np.rint(level), 0, 255).astype(np.uint8))
    if quality is not None:
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=quality)
        picture = Image.open(file)
    return np.asarray(picture)


def letters(size=14.0, lines=LINES):
    """Return the opacity of lines of text, 0 to 1."""
    layer = Image.new("L", (512, 512))
    for place, line in lines.items():
        ImageDraw.Draw(layer).text(place, line, fill=255, font=ImageFont.load_default(size))
    return np.asarray(layer) / 255.0


@pytest.mark.parametrize("grey", [255, 0])
@pytest.mark.parametrize("frames", [1, 5])
@pytest.mark.parametrize("quality", [None, 80])
def test_text_is_found(grey, frames, quality):
    opacity = letters()
    pictures = [stored(level * (1 - opacity) + grey * opacity, quality) for level in anatomy(frames)]
    found = burnt_in_text(pictures)
    assert found[opacity > 0.5].mean() > 0.9
    assert not found[~ndimage.binary_dilation(opacity > 0.1, iterations=16)].any()


def test_text_of_large_pictures_is_found():
    opacity = letters().repeat(2, axis=0).repeat(2, axis=1)
    level = anatomy(1)[0].repeat(2, axis=0).repeat(2, axis=1)
    assert burnt_in_text([stored(level * (1 - opacity) + 255 * opacity)])[opacity > 0.5].mean() > 0.9


@pytest.mark.parametrize("noise", [2.0, 30.0])
@pytest.mark.parametrize("frames", [1, 9])
def test_noise_is_no_text(noise, frames):
    assert not burnt_in_text([stored(level) for level in anatomy(frames, noise)]).any()


@pytest.mark.parametrize("turn", [0.0, 3.0, 30.0])
def test_black_electrodes_are_no_text(turn):
    """Saturated rings of a decapolar catheter, along the rows too."""
    v, u = np.mgrid[0:512, 0:512].astype(float)
    ahead = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    shadow = np.zeros((512, 512))
    for along in np.cumsum([0, 7, 16, 7, 16, 7, 16, 7, 16, 7]):
        du, dv = u - 150 - along * ahead[0], v - 200 - along * ahead[1]
        lengthwise, across = du * ahead[0] + dv * ahead[1], dv * ahead[0] - du * ahead[1]
        shadow += (np.abs(lengthwise) < 2) & (np.abs(across) < 4)
    shadow = ndimage.gaussian_filter(shadow, 0.7)
    assert not burnt_in_text([stored(level - 300 * shadow) for level in anatomy(1)]).any()


def test_saturated_lung_is_no_text():
    (level,) = anatomy(1)
    level[60:300, 40:140] = 400
    level[60:300, 370:480] = 400
    assert not burnt_in_text([stored(level)]).any()


def test_the_field_hides_text():
    opacity = letters()
    (level,) = anatomy(1)
    field = find_field(Frames([stored(level * (1 - opacity) + 255 * opacity)]), FACTS)
    assert not field.candidates[opacity > 0.5].any()
    assert field.inside.all()
    without = field.fill((level * (1 - opacity) + 255 * opacity).astype(np.float32))
    assert np.abs(without - level)[opacity > 0.5].mean() < 15


@pytest.mark.parametrize("grey", [255, 0])
@pytest.mark.parametrize("frames", [1, 5])
def test_text_is_no_catheter(grey, frames):
    opacity = letters(13.0, LIKE_ELECTRODES)
    pictures = [stored(level * (1 - opacity) + grey * opacity) for level in anatomy(frames, 4.0)]
    run = Run(Frames(pictures), np.arange(frames) * 66.7, 3.4, FACTS)
    found = LearnedChain().segment(run, DEFAULT_CATALOGUE, {}, Silent())
    assert not any(entry.chains for entry in found.frames)
