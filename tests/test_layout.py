"""The layout of the package: each room uses only those below it, and CONTRIBUTING lists them in that order."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxtrapolate"


def rooms():
    """The rooms in the order of the table in CONTRIBUTING; what lies at the root is below all of them."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    table = text[text.index("| room |") : text.index("Data flows one way")]
    rows = [row for row in table.splitlines()[2:] if "|" in row]
    return [name for row in rows for name in re.findall(r"`(\w+)/`", row.split("|")[1])]


def imports():
    """All imports of the package's own modules, also those within functions: (importing room, imported room, where)."""
    for path in sorted(PACKAGE.rglob("*.py")):
        here = path.relative_to(PACKAGE).parts
        room = here[0] if len(here) > 1 else ""
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                parts = name.split(".")
                if parts[0] == "jaxtrapolate" and len(parts) > 1:
                    yield room, parts[1] if (PACKAGE / parts[1]).is_dir() else "", f"{path}:{node.lineno}"


def test_every_room_is_listed():
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert set(rooms()) == folders


def test_no_arrow_leads_upward():
    order = ["", *rooms()]
    wrong = [
        f"{where}: {room or 'the root'} uses {used}"
        for room, used, where in imports()
        if order.index(used) > order.index(room) and not where.split(":")[0].endswith("__main__.py")
    ]
    assert not wrong, "\n".join(wrong)


def test_few_modules_at_the_root():
    at_the_root = {p.stem for p in PACKAGE.glob("*.py")} - {"__init__", "__main__", "_version"}
    assert at_the_root == {"atomic", "checks", "errors", "precision", "records", "regular", "results"}


def test_modules_are_short():
    long = {
        p.relative_to(PACKAGE).as_posix(): n
        for p in PACKAGE.rglob("*.py")
        if (n := len(p.read_text().splitlines())) > 460
    }
    assert not long
