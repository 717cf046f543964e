"""What all tables of the pages are made of: measured values, and text."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def read(path: str) -> Any:
    """A JSON file of the repository, or the lines of one that has a value a line."""
    text = (ROOT / path).read_text()
    return [json.loads(line) for line in text.splitlines()] if path.endswith(".jsonl") else json.loads(text)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    rows = list(rows)
    if any(len(row) != len(head) for row in rows):
        raise ValueError(f"table: expected {len(head)} columns in every row, got {[len(row) for row in rows]}")
    first, *others = ("|" + "|".join(f" {cell} " if cell else " " for cell in row) + "|\n" for row in (head, *rows))
    return "".join([first, "|" + "---|" * len(head) + "\n", *others])


def milliseconds(value: float) -> str:
    """With a decimal below 10."""
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"
