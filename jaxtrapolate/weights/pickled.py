"""Pickles as data: a machine for the few opcodes that containers and arrays need, which runs nothing in the file.

A `pickle.Unpickler` that looks up only what is allowed still lets a file set attributes of what it was given (BUILD),
or make room for two thousand million memo entries (LONG_BINPUT). This one never looks a global up: it is a name, and
what may be called by that name is handed over.
"""

import pickletools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

_PUSHED = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "UNICODE"),
    *("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8"),
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_KEYS = (str, int, float, bool, bytes, type(None))


class Global(NamedTuple):
    """A global that a pickle names, as "module.name"."""

    name: str


def _refuse_building(value: Any, state: Any) -> None:
    raise ValueError(f"sets the state of a {type(value).__name__}: refused")


def _refuse_reference(reference: Any) -> Any:
    raise ValueError("holds a reference to data outside the pickle: refused")


def read_pickle(
    data: bytes,
    *,
    names: frozenset[str] = frozenset(),
    calls: Mapping[str, Callable[..., Any]],
    expected: str,
    build: Callable[[Any, Any], None] = _refuse_building,
    refer: Callable[[Any], Any] = _refuse_reference,
) -> Any:
    """What a pickle holds, without running anything in it.

    Args:
        data: the pickle, protocol 2 to 5.
        names: the globals "module.name" that may be named; they become a `Global`.
        calls: those that may be called, and the function that is called instead.
        expected: what the file should hold, for the message about another global.
        build: `(value, state)`, sets the state of a value.
        refer: the value of a persistent reference.

    Returns:
        Dictionaries, lists, tuples, numbers, text, bytes, `None`, and what `calls` and `refer` return. The keys of
        dictionaries are none of the containers.

    Raises:
        ValueError: one line: another global, an opcode that no data needs, or a pickle that is cut off or damaged.
    """
    machine = _Machine(names | frozenset(calls), calls, expected, build, refer)
    try:
        for opcode, argument, _ in pickletools.genops(data):
            machine.step(opcode.name, argument)
    except ValueError:
        raise
    except (IndexError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"damaged pickle ({type(error).__name__}: {error})") from error
    return machine.take()


class _Machine:
    """The stack and the memo of a pickle that is being read."""

    def __init__(self, allowed, calls, expected, build, refer):
        self.allowed, self.calls, self.expected, self.build, self.refer = allowed, calls, expected, build, refer
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def take(self) -> Any:
        """The top of the stack, down to the last mark."""
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise ValueError("damaged pickle (nothing on the stack)")
        return self.stack.pop()

    def top(self) -> Any:
        self.stack.append(value := self.take())
        return value

    def items(self) -> list[Any]:
        """All above the last mark, which goes too."""
        if not self.marks:
            raise ValueError("damaged pickle (no mark on the stack)")
        start = self.marks.pop()
        found = self.stack[start:]
        del self.stack[start:]
        return found

    def step(self, name: str, argument: Any) -> None:
        if name in _PUSHED:
            self.stack.append(argument)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in ("PROTO", "FRAME", "STOP"):
            return
        elif name == "MARK":
            self.marks.append(len(self.stack))
        elif name == "POP":
            self.take()
        elif name == "POP_MARK":
            self.items()
        elif name == "DUP":
            self.stack.append(self.top())
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self.memo[argument] = self.top()
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self.top()
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            self.stack.append(self.memo[argument])
        else:
            self._contain(name, argument)

    def _contain(self, name: str, argument: Any) -> None:
        if name.startswith("EMPTY_") and name != "EMPTY_SET":
            self.stack.append({"EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "EMPTY_DICT": dict}[name]())
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            self.stack.append(tuple([self.take() for _ in range(int(name[-1]))][::-1]))
        elif name == "TUPLE":
            self.stack.append(tuple(self.items()))
        elif name == "LIST":
            self.stack.append(self.items())
        elif name == "DICT":
            items = self.items()
            self.stack.append({})
            self._set(items)
        elif name in ("APPEND", "APPENDS"):
            items = [self.take()] if name == "APPEND" else self.items()
            self._expect(self.top(), list).extend(items)
        elif name == "SETITEM":
            value, key = self.take(), self.take()
            self._set([key, value])
        elif name == "SETITEMS":
            self._set(self.items())
        else:
            self._call(name, argument)

    def _expect(self, value: Any, kind: type) -> Any:
        if type(value) is not kind:
            raise ValueError(f"damaged pickle (a {type(value).__name__} in the place of a {kind.__name__})")
        return value

    def _set(self, items: list[Any]) -> None:
        target = self._expect(self.top(), dict)
        if len(items) % 2:
            raise ValueError("damaged pickle (a key without a value)")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, _KEYS):
                raise ValueError(f"has a {type(key).__name__} as a key")
            target[key] = value

    def _call(self, name: str, argument: Any) -> None:
        if name in ("GLOBAL", "STACK_GLOBAL"):
            if name == "GLOBAL":
                module, attribute = argument.split(" ", 1)
            else:
                attribute, module = self.take(), self.take()
            known = f"{self._expect(module, str)}.{self._expect(attribute, str)}"
            if known not in self.allowed:
                raise ValueError(f"names {' '.join(known.split())[:100]}, where only {self.expected} are expected")
            self.stack.append(Global(known))
        elif name == "REDUCE":
            arguments, function = self._expect(self.take(), tuple), self._expect(self.take(), Global)
            if function.name not in self.calls:
                raise ValueError(f"calls {function.name}, which is no function")
            self.stack.append(self.calls[function.name](*arguments))
        elif name == "BUILD":
            state = self.take()
            self.build(self.top(), state)
        elif name == "BINPERSID":
            self.stack.append(self.refer(self.take()))
        else:
            raise ValueError(f"holds the opcode {name}, which {self.expected} do not need")
