"""The README, the pages and the site: links lead somewhere, examples run, names and figures are right."""

import ast
import doctest
import html.parser
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "experiments" / "README.md",
    *sorted(ROOT.glob("docs/**/*.md")),
]
SLOW = {"README.md", "docs/index.md"}  # their examples render a scene
MODULES = ("files", "metrics", "scenes", "latency", "networks", "weights", "training", "training/losses.py")
MODULES += ("training/extrass_losses.py",)


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def blocks(page, language):
    """The fenced blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text())
    for link in links:
        assert link.startswith("https://") or (page.parent / link).exists(), link


def test_the_readme_is_short_and_leads_to_every_page():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    pages = {p.name for p in ROOT.glob("docs/*.md")}
    assert pages == set(re.findall(r"\]\(docs/(\w+\.md)\)", text))


def navigation():
    text = (ROOT / "mkdocs.yml").read_text()
    return re.findall(r"^ +- (?:[^:\n]*: )?(\S+\.md)$", text[text.index("\nnav:") :], re.MULTILINE)


def test_every_page_is_in_the_navigation():
    pages = [p.relative_to(ROOT / "docs").as_posix() for p in ROOT.glob("docs/**/*.md")]
    assert sorted(navigation()) == sorted([*pages, "CONTRIBUTING.md", "CHANGELOG.md", "experiments/README.md"])


def test_pictures_are_small():
    for path in [*ROOT.glob("docs/*.*g"), *ROOT.glob("docs/operations/*")]:
        limit = 250_000 if path.name == "report.jpg" else 150_000  # a whole page
        assert path.stat().st_size <= limit, path.name


def examples():
    for page in PAGES:
        if blocks(page, "python"):
            marks = [pytest.mark.slow] if name_of(page) in SLOW else []
            yield pytest.param(page, id=name_of(page), marks=marks)


@pytest.mark.parametrize("page", list(examples()))
def test_examples_run(page, tmp_path, monkeypatch, capsys):
    """All Python of a page in one namespace, somewhere else."""
    monkeypatch.chdir(tmp_path)
    tasks = dict(importlib.import_module("jaxtrapolate.training").TASKS)
    try:
        namespace = {"__name__": "example"}
        monkeypatch.setitem(sys.modules, "example", type(sys)("example"))  # where dataclasses look for their module
        for block in blocks(page, "python"):
            exec(compile(block, name_of(page), "exec"), namespace)
    finally:
        importlib.import_module("jaxtrapolate.training").TASKS.clear()
        importlib.import_module("jaxtrapolate.training").TASKS.update(tasks)
    if name_of(page) in SLOW:
        first, *rest = capsys.readouterr().out.splitlines()
        decibels, missing = re.fullmatch(r"(.*) dB, missing: (.*)", first).groups()
        assert float(decibels) > 60  # it stands still
        assert missing == "{}"
        if name_of(page) == "docs/index.md":  # whose second example evaluates two methods
            assert [line.split()[0] for line in rest] == ["repeat", "warp"]


def test_descriptions_of_folders_can_be_read(tmp_path):
    from jaxtrapolate.files.description import read_settings

    found = [block for page in PAGES for block in blocks(page, "toml") if "[buffers]" in block]
    assert len(found) >= 2
    for block in found:
        path = tmp_path / "jaxtrapolate.toml"
        path.write_text(block)
        assert {"color", "motion"} <= set(read_settings(path).buffers)


def test_examples_in_docstrings():
    for path in sorted((ROOT / "jaxtrapolate").rglob("*.py")):
        if re.search(r"^\s*>>> ", path.read_text(), re.MULTILINE):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            assert doctest.testmod(importlib.import_module(name)).failed == 0, name


def public(path):
    """The public names of a module, without running it: what it exports by `X as X`, and what it defines."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            names |= {alias.name for alias in node.names if alias.asname == alias.name}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name) and target.id.isupper()}
    return {name for name in names if not name.startswith("_")}


def public_names():
    """Every public name with its module, as the reference has it."""
    stub = ROOT / "jaxtrapolate" / "__init__.pyi"
    rooms = {path.parent.name for path in (ROOT / "jaxtrapolate").glob("*/__init__.py")}
    names = {f"jaxtrapolate.{name}" for name in public(stub) - rooms} | {"jaxtrapolate.evaluation"}
    for module in MODULES:
        path = ROOT / "jaxtrapolate" / (module if module.endswith(".py") else f"{module}/__init__.py")
        prefix = "jaxtrapolate." + module.removesuffix(".py").replace("/", ".")
        names |= {f"{prefix}.{name}" for name in public(path)}
    return names


def documented(path):
    """Names, arguments and sections Args of a module's functions and of its classes (`__init__`)."""
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        section = re.search(r"^Args:\n(.*?)(?:\n\n|\Z)", ast.get_docstring(node) or "", re.DOTALL | re.MULTILINE)
        taking = [n for n in getattr(node, "body", ()) if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
        function = node if isinstance(node, ast.FunctionDef) else next(iter(taking), None)
        if section is not None:
            assert function is not None, f"{path.name}, {node.name}: has no arguments"
            yield node.name, function.args, section[1]


def test_each_argument_has_a_line_of_its_own():
    """Where a docstring has a section Args, it says something of each argument, one a line, and of no other."""
    seen = 0
    for path in sorted((ROOT / "jaxtrapolate").rglob("*.py")):
        for name, arguments, section in documented(path):
            listed = (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg)
            known = {a.arg for a in listed if a} - {"self", "cls"}
            options = {arguments.kwarg.arg} if arguments.kwarg else set()
            described = re.findall(r"^ {4}\*{0,2}(\w[\w, ]*): ", section, re.MULTILINE)
            where = f"{path.name}, {name}"
            assert known <= set(described), f"{where}: says nothing of {known - set(described)}"
            assert set(described) <= known | options, f"{where}: has no arguments {set(described) - known - options}"
            inside = [a for a in known if re.search(rf"[.;] {a}: ", section)]
            assert not inside, f"{where}: no lines of their own for {inside}"
            seen += 1
    assert seen > 100


class Resources(html.parser.HTMLParser):
    """What a page's browser would fetch, and the names that can be linked to."""

    def __init__(self, text):
        super().__init__()
        self.fetched, self.anchors = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.anchors.add(attributes.get("id"))
        if tag == "link" and attributes.get("rel") not in ("canonical", "prev", "next", "alternate"):
            self.fetched.append(attributes.get("href"))
        self.fetched += [attributes[key] for key in ("src", "srcset", "data", "poster") if attributes.get(key)]


def test_the_site(tmp_path):
    """It builds without a warning, has every public name, and fetches nothing from elsewhere."""
    site = tmp_path / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(site)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    anchors = set()
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(navigation())
    for path in pages:
        page = Resources(path.read_text())
        anchors |= page.anchors
        for place in page.fetched:
            assert not re.match(r"(\w+:)?//", place), f"{path.name}: {place}"
    for path in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", path.read_text()), path.name
    assert public_names() - anchors == set()
    assert not list(site.rglob("*.py"))


def test_tables_are_what_was_measured():
    command = [sys.executable, "docs/tables.py", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
