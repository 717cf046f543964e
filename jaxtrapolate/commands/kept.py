"""What a killed run leaves to go on from: small JSON files."""

import json
import math
from pathlib import Path
from typing import Any

from jaxtrapolate.commands.inputs import output_folder
from jaxtrapolate.files.atomic import atomic_path


def read_json(path: Path) -> Any:
    """What `write_json` wrote, infinite numbers too; None where there is no such file, or no JSON in it."""

    def revive(entry):
        return {k: math.inf if isinstance(v, str) and v == "inf" else v for k, v in entry.items()}

    try:
        return json.loads(path.read_text(), object_hook=revive) if path.exists() else None
    except ValueError:
        return None


def write_json(path: Path, value: Any) -> None:
    """Writes JSON, in full or not at all; infinite numbers as "inf", what is no number as null."""

    def plain(v):
        if isinstance(v, dict):
            return {k: plain(x) for k, x in v.items()}
        if isinstance(v, list | tuple):
            return [plain(x) for x in v]
        if isinstance(v, float) and not math.isfinite(v):
            return "inf" if v > 0 else None  # JSON has neither
        return v

    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=1))


class Kept:
    """Small JSON files that outlive a killed run, as long as the settings are the same."""

    def __init__(self, folder: Path, settings: dict[str, Any]):
        self.folder = output_folder(str(folder))
        if self.read("settings") != settings:
            for path in self.folder.glob("*.json"):
                path.unlink()
            self.write("settings", settings)

    def read(self, name: str) -> Any:
        """The value, None where there is none."""
        return read_json(self.folder / f"{name}.json")

    def write(self, name: str, value: Any) -> None:
        """Keeps the value."""
        write_json(self.folder / f"{name}.json", value)
