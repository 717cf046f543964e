"""What mkdocs does beside its own: pages and pictures from the rest of the repository, and links between them.

Pages link to files of the repository by relative paths, as they are seen there. On the site those in `docs` and in
`PAGES` and `PICTURES` are pages and pictures of it; links to all others lead to the source.
"""

import os
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", "experiments/README.md")
PICTURES = "experiments/results/*.png"


def on_files(files, config):
    """Adds what lies outside `docs`, at the same place as in the repository."""
    for path in [*map(ROOT.joinpath, PAGES), *sorted(ROOT.glob(PICTURES))]:
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, name, abs_src_path=os.fspath(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turns links into the repository into links of the site, or to the source."""
    name = page.file.src_uri
    here = posixpath.dirname(name if name in PAGES else f"docs/{name}")

    def site_link(match):
        target, anchor = match[1], match[2] or ""
        path = posixpath.normpath(posixpath.join(here, target))
        shown = path.removeprefix("docs/")
        if files.get_file_from_path(shown) is not None:
            return f"]({posixpath.relpath(shown, posixpath.dirname(name) or '.')}{anchor})"
        return f"]({config.extra['source']}{path}{anchor})" if (ROOT / path).exists() else match[0]

    return re.sub(r"\]\(((?!\w+:)[^)#\s]+)(#[^)\s]*)?\)", site_link, markdown)
