"""The electrode network on NumPy arrays: products of matrices, for each tap of a window or for each place of Winograd's tiles.

BLAS computes the products, so no inference runtime is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import sgemm

from fluoromap.segmenter.electrodes.network.layers import AROUND, CELL_PX, CONVOLUTIONS, HEADS, Convolution
from fluoromap.segmenter.electrodes.network.scratch_memory import ScratchMemory
from fluoromap.segmenter.electrodes.network.winograd import convolve, transformed_taps
from fluoromap.segmenter.kernels import kernel
from fluoromap.segmenter.picture.log_image import Image

_STRIP_VALUES = 16384
"""Values of a part that a strip of answers reads: they stay in a cache of 1 MB with the products."""

_scratch = ScratchMemory()


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One convolution ready to use: of single pixels, or of a window, with a step of 2 or rectified.

    taps : (width * width, inputs, outputs) float32, row by row of the window; for a window without steps (36, inputs, outputs),
    see :func:`~fluoromap.segmenter.electrodes.network.winograd.transformed_taps`. bias : (outputs,) float32. Batch normalisation is
    folded into both.
    """

    shape: Convolution
    taps: Image
    bias: Image

    @classmethod
    def of_weights(cls, shape: Convolution, taps: Image, bias: Image) -> Layer:
        """Build from taps (width, width, inputs, outputs) and bias (outputs,)."""
        flat = np.ascontiguousarray(taps, np.float32).reshape(-1, shape.inputs, shape.outputs)
        if shape.stride == 1 and shape.width > 1:
            flat = transformed_taps(flat)
        return cls(shape, flat, np.ascontiguousarray(bias, np.float32))

    def __call__(self, x: Image) -> Image:
        """Apply to (rows, columns, inputs); returns (rows / stride, columns / stride, outputs)."""
        out = np.empty(self.answer_shape(x), np.float32)
        self.write(x, out)
        return out

    def answer_shape(self, x: Image) -> tuple[int, int, int]:
        """Return the shape of the answer to (rows, columns, inputs)."""
        return x.shape[0] // self.shape.stride, x.shape[1] // self.shape.stride, self.shape.outputs

    def write(self, x: Image, out: Image) -> None:
        """Write the answer to (rows, columns, inputs) into ``out``."""
        if self.shape.width == 1:
            flat = _scratch.array("products", out.shape[0] * out.shape[1], self.shape.outputs)
            np.matmul(x.reshape(-1, self.shape.inputs), self.taps[0], out=flat)
            _add_bias(
                flat.reshape(out.shape[0], -1), self._bias_of_row(out), self._least, out.reshape(out.shape[0], -1)
            )
        elif self.shape.stride == 1:
            convolve(x, self.taps, self.bias, self.shape.dilation, out)
        else:
            self._write_with_steps(x, out)

    @property
    def _least(self) -> np.float32:
        """Smallest value that the layer answers."""
        return np.float32(0.0 if self.shape.rectified else -1e30)

    def _bias_of_row(self, out: Image) -> Image:
        """Return the bias of all pixels of a row of ``out``, one after the other."""
        return np.tile(self.bias, out.shape[1])

    def _write_with_steps(self, x: Image, out: Image) -> None:
        """Sum over the taps: pixels shifted by the tap, times (inputs x outputs).

        The padded picture is stored as its four interleaved parts, so that a tap reads successive pixels of one part. Rows of a
        part follow each other in memory: a shifted part is the same memory from another start on.
        """
        width, inputs, border = self.shape.width, self.shape.inputs, self.shape.width // 2
        rows, columns, outputs = out.shape
        wide = columns + border
        parts = _padded_parts(x, border, rows, wide)
        starts = [
            (2 * (down % 2) + right % 2, down // 2 * wide + right // 2)
            for down, right in (divmod(tap, width) for tap in range(width**2))
        ]
        bias = self._bias_of_row(out)
        strip = max(1, _STRIP_VALUES // (wide * inputs))
        for row in range(0, rows, strip):
            first, last = row * wide, min(row + strip, rows) * wide
            products = _scratch.array("products", last - first, outputs)
            shifted = [parts[part, first + start : last + start] for part, start in starts]
            if inputs == 1:
                windows = _scratch.array("windows", width**2, last - first)
                np.concatenate([pixels[:, 0] for pixels in shifted], out=windows.reshape(-1))
                np.matmul(windows.T, self.taps[:, 0], out=products)
            else:
                for tap, pixels in enumerate(shifted):
                    added_to = 0.0 if tap == 0 else 1.0
                    sgemm(1.0, self.taps[tap].T, pixels.T, beta=added_to, c=products.T, overwrite_c=1)
            answers = out[row : row + strip]
            _add_bias(products.reshape(len(answers), -1), bias, self._least, answers.reshape(len(answers), -1))


def _padded_parts(x: Image, border: int, rows: int, wide: int) -> Image:
    """Return the four interleaved parts of the padded picture, each (pixels, channels).

    First come its even rows: their even columns, then the odd ones. A part has a row more than needed, because the last taps of
    the last row read into it.
    """
    channels = x.shape[2]
    parts = _scratch.around(f"parts {channels}", x.shape, 4, rows + border + 1, wide, channels)
    for down in range(2):
        for right in range(2):
            part = parts[2 * ((down + border) % 2) + (right + border) % 2]
            pixels = x[down::2, right::2]
            top, left = (down + border) // 2, (right + border) // 2
            part[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    return parts.reshape(4, -1, channels)


@dataclass(frozen=True, slots=True)
class Part:
    """A rectangle of a picture, from (top, left) to before (bottom, right)."""

    top: int
    left: int
    bottom: int
    right: int

    @classmethod
    def whole(cls, picture: Image) -> Part:
        """Return the part that is the whole of a picture (rows, columns, ...)."""
        return cls(0, 0, *picture.shape[:2])

    def at_half(self) -> Part:
        """Return the part that this part needs at half the size."""
        return Part(self.top // 2, self.left // 2, -(-self.bottom // 2), -(-self.right // 2))

    def at_double(self) -> Part:
        """Return the same part at double the size."""
        return Part(2 * self.top, 2 * self.left, 2 * self.bottom, 2 * self.right)

    def with_border(self, width: int, whole: Part) -> Part:
        """Return the part with a border, as far as the whole has one."""
        return Part(
            max(self.top - width, whole.top), max(self.left - width, whole.left),
            min(self.bottom + width, whole.bottom), min(self.right + width, whole.right),
        )  # fmt: skip

    def of(self, picture: Image, shown: Part) -> Image:
        """Return this part of a picture that shows another part.

        It lies in one stretch of memory.
        """
        rows = slice(self.top - shown.top, self.bottom - shown.top)
        return np.ascontiguousarray(picture[rows, self.left - shown.left : self.right - shown.left])


@dataclass(frozen=True, slots=True, eq=False)
class ElectrodeNetwork:
    """All layers with their weights. See :class:`~fluoromap.training.network.ElectrodeNetwork`, which it repeats."""

    layers: dict[str, Layer]

    @classmethod
    def of_weights(cls, weights: dict[str, Image]) -> ElectrodeNetwork:
        """Build from ``name.taps`` (width, width, inputs, outputs) and ``name.bias`` (outputs,).

        Raises
        ------
        ValueError
            When a layer is missing or has another shape.
        """
        layers = {}
        for name, shape in CONVOLUTIONS.items():
            taps, bias = weights.get(f"{name}.taps"), weights.get(f"{name}.bias")
            expected = (shape.width, shape.width, shape.inputs, shape.outputs)
            if taps is None or bias is None or taps.shape != expected or bias.shape != (shape.outputs,):
                found = "nothing" if taps is None else f"shape {taps.shape}"
                raise ValueError(
                    f"layer {name!r} of the weights needs taps of shape {expected} with a bias, but has {found}: "
                    "train the weights with this version"
                )
            layers[name] = Layer.of_weights(shape, taps, bias)
        return cls(layers)

    def __call__(self, picture: Image, cells: Part | None = None) -> Image:
        """Answers of cells of a normalised picture.

        Each layer leaves out what the cells do not depend on.

        Parameters
        ----------
        picture : (rows, columns) float32
            Both multiples of 8.
        cells : Part, optional
            The cells of 2 x 2 px to answer for; all by default.

        Returns
        -------
        (rows of cells, columns of cells, 5) float32, see :data:`~fluoromap.segmenter.electrodes.network.layers.HEADS`.
        """
        half = self._answer("at_half", picture[..., None])
        quarter = self._answer("at_quarter_again", self._answer("at_quarter", half))
        eighth = self._answer("at_eighth", quarter)
        asked = Part.whole(half) if cells is None else cells
        needed = self._needed(asked, Part.whole(quarter), Part.whole(eighth))
        shown = needed[0]
        eighth = shown.of(eighth, Part.whole(eighth))
        for name, after in zip(AROUND, needed[1:], strict=True):
            eighth += self._answer(name, eighth)
            eighth, shown = after.of(eighth, shown), after
        wide = self._answer("back", eighth)
        quarter = shown.at_double().of(quarter, Part.whole(quarter))
        rows, columns, channels = quarter.shape
        quarter.reshape(rows // 2, 2, columns // 2, 2, channels)[:] += wide[:, None, :, None]
        heads = self._answer("heads", self._answer("merged", quarter))
        of_cells = heads.reshape(rows, columns, len(HEADS), CELL_PX, CELL_PX).transpose(0, 3, 1, 4, 2)
        return asked.of(of_cells.reshape(2 * rows, 2 * columns, len(HEADS)), shown.at_double().at_double())

    def _needed(self, cells: Part, quarter: Part, eighth: Part) -> list[Part]:
        """Return the parts that cells need at an eighth of the size.

        They are needed before the first layer around, and after each of them.
        """
        merged = cells.at_half().with_border(self.layers["merged"].shape.border, quarter)
        needed = [merged.at_half()]
        for name in reversed(AROUND):
            needed.append(needed[-1].with_border(self.layers[name].shape.border, eighth))
        return needed[::-1]

    def _answer(self, name: str, x: Image) -> Image:
        """Return a layer's answer; the next picture's answer replaces it."""
        layer = self.layers[name]
        out = _scratch.array(name, *layer.answer_shape(x))
        layer.write(x, out)
        return out


@kernel("f4[:,::1], f4[::1], f4, f4[:,::1]")
def _add_bias(flat, bias, least, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the first values of each row with the bias added.

    Rows of ``flat`` may be longer than ``bias`` and the rows of ``out``. ``least`` : smaller values become this.
    """
    for v in range(out.shape[0]):
        source, target = flat[v], out[v]
        for u in range(bias.size):
            target[u] = max(source[u] + bias[u], least)
