"""The README and the pages: short, with links that lead somewhere, and an example that runs."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "experiments" / "README.md",
    *sorted(ROOT.glob("docs/*.md")),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text())
    for link in links:
        assert link.startswith("https://") or (page.parent / link).exists(), link


def test_the_readme_is_short():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    pages = {p.name for p in ROOT.glob("docs/*.md")}
    assert pages == set(re.findall(r"\]\(docs/(\w+\.md)\)", text))


@pytest.mark.slow
def test_the_example_of_the_readme(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    decibels, missing = re.fullmatch(r"(.*) dB, missing: (.*)\n", capsys.readouterr().out).groups()
    assert float(decibels) > 60  # it stands still
    assert missing == "{}"
