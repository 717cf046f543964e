"""How long a method takes, and each of its stages on its own."""

from typing import Any

from jaxtrapolate.evaluation.windows import Window, arguments
from jaxtrapolate.methods.method import Method
from jaxtrapolate.runtime.timing import Timing, measure


def time_method(method: Method, window: Window, *, repeats: int = 5) -> Timing:
    """A whole method on one frame; one with memory from a new start.

    Args:
        method: any.
        window: the frame to be generated and what surrounds it.
        repeats: runs that count.
    """
    history, target, future = arguments(method, window)
    carry = method.init(history, target)
    return measure(lambda: method.step(carry, history, target, future), repeats=repeats)


def time_stages(method: Method, window: Window, *, carry: Any = None, repeats: int = 5) -> dict[str, Timing]:
    """Each stage of a method on its own; their sum exceeds the whole, in which XLA fuses across stages.

    Args:
        method: any.
        window: the frame to be generated and what surrounds it.
        carry: what a method with memory remembers; `None` starts it anew.
        repeats: runs of each stage that count.
    """
    history, target, future = arguments(method, window)
    carry = method.init(history, target) if carry is None else carry
    values = method.first_values(carry, history, target, future)
    timings = {}
    for stage in method.active(history, target, future):
        run = method.jitted_stages[stage.name]
        timings[stage.name] = measure(run, method.state, dict(values), repeats=repeats)
        values |= run(method.state, dict(values))
    return timings
