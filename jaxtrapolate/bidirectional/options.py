"""What may be chosen of an image-based interpolation: how points are searched for, and when they count as visible.

Thresholds are traced, so that they may be differentiated or swept without a new program; all else is static.
"""

import dataclasses
from functools import partial
from typing import Any, Literal, get_args

import jax
from jaxtyping import Float

from jaxtrapolate.bidirectional.search import FlowFilter, Solver, check_search
from jaxtrapolate.checks import ArrayLike, check_choice, check_scalar
from jaxtrapolate.records import DepthKind

Start = Literal["default", "dual", "latest"]
Choice = Literal["error", "depth"]
VisibilityTest = Literal["auto", "depth", "round_trip", "inside"]


@partial(
    jax.tree_util.register_dataclass, data_fields=["epsilon"],
    meta_fields=["starts", "reach", "iterations", "solver", "filter", "choice"],
)  # fmt: skip
@dataclasses.dataclass(frozen=True)
class SearchOptions:
    """How a point is searched for in a rendered frame, and which of the solutions counts (5.1 and 5.3).

    starts: "default" (the pixel itself), "dual" (by the other frame's flow), "latest" (by the offsets of the frame
    interpolated last; left out without them). reach: of the neighbourhood that "latest" takes the nearest surface's
    offset from. iterations, solver: as in `iterative_search`. filter: how the flow, and the depth with it, is fetched:
    across a silhouette "bilinear" finds points of a surface that is not there; "nearest" misses, as it should. choice:
    among the starts' solutions: "depth", the nearest point of those that hit, else the smallest error; or "error",
    always the smallest, as the paper has it. epsilon: in pixels, a search with a smaller error hits; traced.
    """

    starts: tuple[Start, ...] = ("default", "dual", "latest")
    reach: int = 1
    iterations: int = 3
    solver: Solver = "fixed_point"
    filter: FlowFilter = "nearest"
    choice: Choice = "depth"
    epsilon: float | Float[ArrayLike, ""] = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "starts", tuple(self.starts))  # a list has no hash


@partial(jax.tree_util.register_dataclass, data_fields=["epsilon_depth", "epsilon_trip"], meta_fields=["test", "depth"])
@dataclasses.dataclass(frozen=True)
class VisibilityOptions:
    """When a point counts as visible in the other frame, and two points as one (5.2).

    test: "depth": the point's depth agrees with the buffer there; "round_trip": the other frame's flow leads back;
    "inside": it is in the frame; "auto": by depth where that is metric and both flows have three components, else by
    the round trip. depth: "metric", the distance along the view axis; or "ordinal": only comparable between the two
    frames, smaller is nearer, unchanged by the flow. epsilon_depth: by how much depths of one point may differ,
    relative to the smaller if metric, else as a difference; traced. epsilon_trip: by how many pixels a round trip may
    miss; traced.
    """

    test: VisibilityTest = "auto"
    depth: DepthKind = "metric"
    epsilon_depth: float | Float[ArrayLike, ""] = 0.05
    epsilon_trip: float | Float[ArrayLike, ""] = 1.0


def check_search_options(search: Any) -> None:
    """Raise unless `search` are valid options."""
    if not isinstance(search, SearchOptions):
        raise TypeError(f"search: expected SearchOptions, got {type(search).__name__}")
    check_search(iterations=search.iterations, solver=search.solver, filter=search.filter)
    check_choice("choice", search.choice, get_args(Choice))
    for start in search.starts:
        check_choice("starts", start, get_args(Start))
    if not isinstance(search.reach, int) or search.reach < 0:
        raise ValueError(f"reach: expected an integer of at least 0, got {search.reach!r}")
    check_scalar("epsilon", search.epsilon)


def check_visibility_options(visibility: Any) -> None:
    """Raise unless `visibility` are valid options."""
    if not isinstance(visibility, VisibilityOptions):
        raise TypeError(f"visibility: expected VisibilityOptions, got {type(visibility).__name__}")
    check_choice("depth", visibility.depth, get_args(DepthKind))
    check_choice("test", visibility.test, get_args(VisibilityTest))
    check_scalar("epsilon_depth", visibility.epsilon_depth)
    check_scalar("epsilon_trip", visibility.epsilon_trip)
