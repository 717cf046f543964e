"""The error of input that cannot be used, whose message is for users, and text that any terminal can print."""

_LONGEST = 2000


class InputError(Exception):
    """Input that cannot be used; the message is one line that names the file and the remedy.

    It can be printed whatever a file's name or content is (`printable`). With `argument`, the name of what the message
    is about, "{argument}" in the message stands for that: `frames` in Python, `--frames` on the command line.
    """

    def __init__(self, *args: object, argument: str | None = None) -> None:
        super().__init__(*(printable(arg) if isinstance(arg, str) else arg for arg in args))
        self.argument = argument

    def __str__(self) -> str:
        return self._said("")

    @property
    def on_command_line(self) -> str:
        """The message to who gave the argument as an option of a command."""
        return self._said("--")

    def _said(self, prefix: str) -> str:
        text = super().__str__()
        return text if self.argument is None else text.replace("{argument}", prefix + self.argument)


def printable(text: object) -> str:
    r"""A text in one line that any terminal takes: what is not printable is escaped, the middle of a long one left out.

    The bytes of a file's name that are no UTF-8 are shown as "\udcff", a line's end as "\n".
    """
    text = str(text)
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
