"""How long each stage of a method takes on its own."""

from jaxtrapolate.evaluation.windows import Window, arguments
from jaxtrapolate.methods.method import Method
from jaxtrapolate.runtime.timing import Timing, measure


def time_stages(method: Method, window: Window, *, repeats: int = 5) -> dict[str, Timing]:
    """Each stage of a method on its own; their sum exceeds the whole, in which XLA fuses across stages."""
    history, target, future = arguments(method, window)
    values = method.first_values(method.init(history, target), history, target, future)
    timings = {}
    for stage in method.active(history, target, future):
        run = method.jitted_stages[stage.name]
        timings[stage.name] = measure(run, method.state, dict(values), repeats=repeats)
        values |= run(method.state, dict(values))
    return timings
