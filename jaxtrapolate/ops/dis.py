"""Dense optical flow by inverse search of patches (Kroeger et al. 2016, "DIS")."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from jaxtrapolate.checks import ArrayLike, Size, check_choice, check_image
from jaxtrapolate.ops.patches import PATCH, centres, cut, densify, patches, search, second_image
from jaxtrapolate.ops.refinement import Weights, refine
from jaxtrapolate.ops.resample import gray_levels, resize
from jaxtrapolate.ops.strips import once

Preset = Literal["ultrafast", "fast", "medium"]


class Effort(NamedTuple):
    """What a preset stands for.

    Attributes:
        finest: the flow is found at 1 / 2^finest of the size.
        stride: of the patches, in pixels of a level.
        steps: of a patch's search, before and after it is told its neighbours' displacements.
        refinements: of the dense flow, at each level.
    """

    finest: int
    stride: int
    steps: int
    refinements: int


_TURNS = 8  # of the search at the smallest size, where nothing is known yet; 1 at the others


EFFORTS: dict[str, Effort] = {
    "ultrafast": Effort(2, 4, 2, 0),
    "fast": Effort(2, 4, 3, 2),
    "medium": Effort(1, 3, 3, 2),
}


def level_sizes(size: Size) -> list[Size]:
    """Sizes of the pyramid's levels, each half of the one before: until 4 patches span the image, or 1 its height."""
    longest, shortest = max(size), min(size)
    deepest = min(round(math.log2(max(longest / (4 * PATCH), 1))), int(math.log2(max(shortest / PATCH, 1))))
    return [(max(1, size[0] >> k), max(1, size[1] >> k)) for k in range(deepest + 1)]


def enlarged(flow: Complex[Array, "h w"], size: Size) -> Complex[Array, "i j"]:
    """A flow at a larger size, in its pixels."""
    if flow.shape == size:
        return flow
    down, across = (new / old for new, old in zip(size, flow.shape, strict=True))
    return jax.lax.complex(resize(jnp.real(flow), size) * across, resize(jnp.imag(flow), size) * down)


def like(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """How much pixels with two guides count for each other, channel by channel, in units of their sigma."""
    # terms that are added are one loop; XLA on a CPU makes a sum over an axis of few one of its own
    return jnp.exp(-0.5 * sum(jnp.square(one - other) for one, other in zip(a, b, strict=True)))


class Guidance(NamedTuple):
    """What windows are weighted with: guides `[G, H, W]` in units of their sigma, and where there is an image."""

    guide: Float[Array, "g h w"]
    valid: Float[Array, "h w"]

    def resized(self, size: Size) -> "Guidance":
        """At a smaller size: means of what a pixel covers."""
        guide = jnp.stack([resize(a, size, kind="area") for a in self.guide])
        return Guidance(guide, resize(self.valid, size, kind="area"))

    def of_patches(self, stride: int) -> Float[Array, "8 8 n"]:
        """Of the patches' pixels: valid, and like the patch's middle."""
        taps = [cut(image, stride) for image in self.guide]
        middles = [centres(image, stride)[None, None] for image in self.guide]
        return like(taps, middles) * cut(self.valid, stride)

    def of_neighbours(self) -> Weights:
        """Of pixels, valid, and of each for the next to the right and below, which it is like."""

        def beside(axis):
            size = self.guide.shape[axis]
            after = jnp.take(self.guide, jnp.minimum(jnp.arange(1, size + 1), size - 1), axis)
            return once(like(tuple(self.guide), tuple(after)))

        return Weights(self.valid, beside(2), beside(1))


def inverse_search_flow(
    first: Float[Array, "h w"], second: Float[Array, "h w"], effort: Effort, guidance: Guidance | None = None
) -> Complex[Array, "i j"]:
    """The flow, x + i y, between images of grey levels 0..255, in pixels of its finest level; see `dis_flow`."""
    sizes = level_sizes((first.shape[0], first.shape[1]))
    finest = min(effort.finest, len(sizes) - 1)
    images = [(first, second, guidance)]
    for smaller in sizes[1:]:
        first, second = (once(resize(a, smaller, kind="area")) for a in (first, second))
        guidance = None if guidance is None else guidance.resized(smaller)
        images.append((first, second, guidance))
    zero = jnp.zeros(sizes[-1], first.dtype)
    flow = jax.lax.complex(zero, zero)
    for (first, second, level), shape in reversed(list(zip(images, sizes, strict=True))[finest:]):
        flow = enlarged(flow, shape)
        weight, edges = (None, None) if level is None else (level.of_patches(effort.stride), level.of_neighbours())
        kept = patches(first, effort.stride, weight)
        there = second_image(second, effort.stride)
        start = centres(jnp.real(flow), effort.stride), centres(jnp.imag(flow), effort.stride)
        turns = _TURNS if shape == sizes[-1] else 1
        x, y = search(kept, there, start, steps=effort.steps, turns=turns)
        flow = densify(kept, there, x, y, flow)
        if effort.refinements:
            flow = refine(first, second, flow, iterations=effort.refinements, weights=edges)
    return flow


@partial(jax.jit, static_argnames=("preset",))
def _dis(first, second, *, preset):
    flow = inverse_search_flow(gray_levels(first), gray_levels(second), EFFORTS[preset])
    flow = enlarged(flow, (first.shape[0], first.shape[1]))
    return jnp.stack([jnp.real(flow), jnp.imag(flow)], -1).astype(first.dtype)


def dis_flow(
    first: Float[ArrayLike, "h w 1"], second: Float[ArrayLike, "h w 1"], *, preset: Preset = "medium"
) -> Float[Array, "h w 2"]:
    """Optical flow by inverse search of patches: p of the first image is at p + flow[p] of the second.

    From a small image to a large one: patches of 8 x 8 pixels of the first image are looked for in the second by steps
    along the first's gradient; each pixel takes the mean of its patches' displacements, those that fit it first; the
    result is refined so that grey levels and their gradients are kept and the flow is smooth.

    Args:
        first: `[H, W, 1]`, grey levels as displayed, 0 to 1.
        second: likewise.
        preset: "ultrafast" (a quarter of the size, patches every 4 pixels, no refinement), "fast" (with it), or
            "medium" (half the size, patches every 3 pixels).

    Returns:
        `[H, W, 2]` in pixels, of the dtype of `first`. Computed in at least float32.

    Convention:
        Pull: fetching the second image along the flow (`backward_warp`) gives the first. Pixels, x right, y down.

    Edge cases:
        Without texture the flow is 0. Pixels that are not finite are filled from around them first (`fill_pyramid`).
        Grey levels are held to -1000..1000.
        Images repeat their edge. Images that are too small for a preset's size are searched at their own.

    Gradient:
        With respect to both images, through all steps; which steps are taken is held fixed. Of the bilinear fetches it
        is that of `backward_warp`.

    Raises:
        TypeError, ValueError: no floating-point array, sizes that differ, or an unknown preset.

    References:
        Kroeger et al. 2016 (Fast optical flow using dense inverse search), with the pyramids, presets and constants
        of OpenCV's DISOpticalFlow. Departures: images need not be of 8 bits; whole Gauss-Newton steps, shortened where
        they make it worse; displacements are passed on to all four neighbours at once, not in the order of rows; the
        refinement's derivatives are those of the image, not twice as large, so that two iterations of it do for
        OpenCV's five, and its 2 x 2 systems are solved whole.
    """
    size = check_image("first", first, channels=1)
    check_image("second", second, size=size, channels=1)
    check_choice("preset", preset, get_args(Preset))
    return _dis(first, second, preset=preset)
