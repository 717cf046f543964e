"""Baselines that warp a coarse grid laid over a rendered frame, its colour undivided: nothing is demodulated.

The papers' warps go forward from one frame; see `jaxtrapolate.ops.grid.grid_warp` for what departs from them.
"""

import jax.numpy as jnp

from jaxtrapolate.methods.between import BETWEEN, FLOWS, PAIR, depth_of
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import option, settings
from jaxtrapolate.methods.reprojection import CAMERA, LINEAR, NEWEST, ONWARD, carried_depth
from jaxtrapolate.methods.space import Space, in_space, space
from jaxtrapolate.methods.stage import Stage, Values
from jaxtrapolate.ops.fill import fill_pyramid
from jaxtrapolate.ops.grid import grid_warp as warp_grid


@settings
class GridSettings:
    """Of the grid; small cells stand for the refinement near silhouettes, which a uniform grid has not."""

    cell: int = option(4, "the width of a cell in pixels", low=1, high=256)
    tear: float = option(2.0, "a cell is torn where an edge gets longer by this factor", low=1, high=1e6)
    space: Space = space()


def _warped(image, moved, how: GridSettings):
    """The image on its moved grid, and where it is covered."""

    def fetch(image):
        warped, covered = warp_grid(image, *moved, cell=how.cell, tear=how.tear)
        return jnp.concatenate([covered[..., None].astype(warped.dtype), warped], -1)

    found = in_space(how.space, fetch, image)
    return {"warped": found[..., 1:], "covered": found[..., 0] > 0}


def _fill(state, values: Values):
    return {"image": fill_pyramid(values["warped"], values["covered"])}


_FILL = Stage("fill", _fill, ("warped", "covered"), ("image",))


def grid_warp() -> Method:
    """Interpolation: the previous frame's grid, moved by a fraction alpha of its flow to the next rendered frame.

    Its cells are 4 pixels wide; holes are filled by a pyramid.

    References: Didyk et al. 2010, whose flow to the next frame is exact; ours is the chained backward motion turned
    around (`complete_flows`). Schollmeyer et al. 2017, for the filling of holes in several scales.
    """

    def function(state, values: Values):
        previous = values["previous"]
        moved = values["forward"], depth_of(previous), values["alpha"]
        return _warped(previous.color, moved, state.settings)

    warp = Stage("grid warp", function, ("previous", "forward", "alpha"), ("warped", "covered"))
    stages = (PAIR, BETWEEN, FLOWS, warp, _FILL)
    return Method("grid_warp", stages, kind="interpolation", future=1, settings=GridSettings())


def grid_extrapolate() -> Method:
    """Extrapolation: the newest frame's grid, moved by the motion that "warp_3d" pushes its pixels along.

    References: as of `grid_warp`; Guo et al. 2021 (ExtraNet), Table 4, compare with it in this form.
    """

    def function(state, values: Values):
        depth = None if depth_of(values["newest"]) is None else carried_depth(values)
        return _warped(values["newest"].color, (values["onward"], depth, 1.0), state.settings)

    warp = Stage("grid warp", function, ("newest", "onward", "deeper"), ("warped", "covered"))
    stages = (NEWEST, LINEAR, CAMERA, ONWARD, warp, _FILL)
    return Method("grid_extrapolate", stages, settings=GridSettings())
