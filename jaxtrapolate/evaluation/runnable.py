"""Which methods can be scored on a sequence, why the others cannot, and what those that can cost the rest."""

from collections.abc import Mapping

from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.schedule import held_back_slots
from jaxtrapolate.evaluation.windows import arguments, held_back, hidden, load
from jaxtrapolate.files import Sequence, runs
from jaxtrapolate.methods import Method


def runnable(
    sequence: Sequence, methods: Mapping[str, Method], unavailable: Mapping[str, str], *, factor: int = 2
) -> tuple[dict[str, Method], dict[str, str], dict[str, dict[str, list[str]]]]:
    """The methods that can be scored, why the others cannot, and what stages are left out of each that can.

    Raises:
        InputError: none can.
    """
    usable, skipped, left_out = {}, dict(unavailable), {}
    for name, method in methods.items():
        if method.scale not in (1, sequence.scale):
            skipped[name] = f"generates frames {method.scale} times as large, which the input does not have as truth"
            continue
        slots = held_back_slots(sequence, past=method.past, future=method.future, factor=factor)
        chosen = next((slot for slot in slots if slot.full and not slot.rendered), None)
        if chosen is None:
            skipped[name] = (
                f"too few frames, needs {_window_length(method, factor)} in a row without a gap; the longest row of "
                f"the {len(sequence.numbers)} has {max(map(len, runs(sequence)))}"
            )
            continue
        drawn = next((slot for slot in slots if slot.full and slot.rendered), None) if method.scale > 1 else None
        tried = [s for s in slots if s in (chosen, drawn) or (method.memory and s is slots[0])]
        try:
            for slot, window in load(sequence, tried, hidden=hidden(sequence, factor=factor)):
                if window.truth.color is None:
                    text = f"frame {slot.number} has no colour to compare with; use generate"
                    raise InputError(f"{sequence.name}: {text}")
                method.active(*arguments(method, window))
                if slot == chosen:
                    left_out[name] = method.missing(*arguments(method, window))
            usable[name] = method
        except ValueError as error:
            skipped[name] = str(error)
            left_out.pop(name, None)
    if not usable:
        reasons = "; ".join(f"{name}: {why}" for name, why in skipped.items())
        raise InputError(f"{sequence.name}: no method can run: {reasons}")
    return usable, skipped, left_out


def _window_length(method: Method, factor: int) -> int:
    """How many frames in a row a method's window has, the held-back one included."""
    if not method.future:
        return factor * (method.past - 1) + 2
    return factor * (method.past - 1) + 1 + factor * method.future


def history_costs(sequence: Sequence, methods: Mapping[str, Method], *, factor: int = 2) -> list[str]:
    """For methods that need more frames around a held-back one than the others: how many scored frames that costs."""

    def count(chosen: Mapping[str, Method]) -> int:
        past, future = max(m.past for m in chosen.values()), max(m.future for m in chosen.values())
        return len(held_back(sequence, past=past, future=future, factor=factor))

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
