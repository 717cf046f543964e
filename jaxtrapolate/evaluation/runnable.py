"""Which methods can be scored on a sequence, why the others cannot, and what those that can cost the rest."""

from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.windows import arguments, held_back, windows
from jaxtrapolate.files import Sequence, runs
from jaxtrapolate.methods import Method


def runnable(
    sequence: Sequence, methods: dict[str, Method], unavailable: dict[str, str]
) -> tuple[dict[str, Method], dict[str, str], dict[str, dict[str, list[str]]]]:
    """The methods that can be scored, why the others cannot, and what stages are left out of each that can.

    Raises:
        InputError: none can.
    """
    usable, skipped, left_out = {}, dict(unavailable), {}
    for name, method in methods.items():
        numbers = held_back(sequence, past=method.past, future=method.future)
        if not numbers:
            skipped[name] = (
                f"too few frames, needs {_window_length(method)} in a row without a gap; the longest row of the "
                f"{len(sequence.numbers)} has {max(map(len, runs(sequence)))}"
            )
            continue
        window = next(iter(windows(sequence, numbers[:1], past=method.past, future=method.future)))
        if window.truth.color is None:
            raise InputError(f"{sequence.name}: frame {window.number} has no colour to compare with; use generate")
        given = arguments(method, window)
        try:
            method.active(*given)
            usable[name], left_out[name] = method, method.missing(*given)
        except ValueError as error:
            skipped[name] = str(error)
    if not usable:
        reasons = "; ".join(f"{name}: {why}" for name, why in skipped.items())
        raise InputError(f"{sequence.name}: no method can run: {reasons}")
    return usable, skipped, left_out


def _window_length(method: Method) -> int:
    """How many frames in a row a method's window has, the held-back one included."""
    return 2 * method.past + max(0, 2 * method.future - 1)


def history_costs(sequence: Sequence, methods: dict[str, Method]) -> list[str]:
    """For methods that need more frames around a held-back one than the others: how many scored frames that costs."""

    def count(chosen: dict[str, Method]) -> int:
        past, future = max(m.past for m in chosen.values()), max(m.future for m in chosen.values())
        return len(held_back(sequence, past=past, future=future))

    notes, all_of_them = [], count(methods)
    for what, need in (("before", lambda m: m.past), ("after", lambda m: m.future)):
        most = max(need(m) for m in methods.values())
        demanding = [name for name, m in methods.items() if need(m) == most]
        others = {name: m for name, m in methods.items() if name not in demanding}
        cost = count(others) - all_of_them if others else 0
        if cost:
            names = f"{', '.join(demanding)} need{'s' if len(demanding) == 1 else ''}"
            notes.append(
                f"{names} {most} rendered frame{'s' if most > 1 else ''} {what} a held-back one: {all_of_them} frames "
                f"can be scored; without {'it' if len(demanding) == 1 else 'them'} there are {cost} more"
            )
    return notes
