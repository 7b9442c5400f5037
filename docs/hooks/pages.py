"""Hooks of MkDocs: pages for the files outside docs/ that pages link to, and generated parts.

A page links to `../../configs/arbiter.yaml` as a reader of the source tree would. On the site that
link leads to a page with the file's text, or for a JSON Schema to its reference; ARCHITECTURE.md
and its neighbors become pages of their own. A link to anything that does not exist is left as it
is, and MkDocs warns of it.

A line `<!-- generated: NAME -->` is replaced by what `GENERATED[NAME]` returns.
"""

import posixpath
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from docs.hooks import contracts, programs

TREE = Path(__file__).parents[2]
LINK = re.compile(r"(?<=\]\()(?!\w+:|#)([^)#\s]+)")
# Pages at the root of the source tree, and their places on the site.
ROOT_PAGES = {
    "ARCHITECTURE.md": "explanation/architecture.md",
    "CHANGELOG.md": "reference/changelog.md",
    "CONTRIBUTING.md": "explanation/contributing.md",
    "README.md": "explanation/readme.md",
    "SECURITY.md": "explanation/security.md",
}
SCHEMAS = "schemas/json/"
# Front matter of pages that the search leaves out: their names are explained on other pages, and
# the index is loaded and searched by the browser.
UNSEARCHED = "---\nsearch:\n  exclude: true\n---\n"
SOURCES = "source"  # folder of the pages that show a file
LANGUAGES = {".py": "python", ".pl": "perl", ".yaml": "yaml", ".json": "json", ".toml": "toml"}

GENERATED: Mapping[str, Callable[[], str]] = {
    "configuration": lambda: contracts.configuration((TREE / "configs/arbiter.yaml").read_text()),
    "errors": contracts.errors,
    "schemas": lambda: contracts.schema_list(TREE / SCHEMAS),
    "metrics": contracts.metrics,
    "decisions": lambda: contracts.decisions(TREE / "docs/explanation/adr"),
    "selftest": contracts.selftest,
    **{name: partial(programs.page, name) for name in programs.parsers()},
}
MARK = re.compile(r"^<!-- generated: ([\w-]+) -->$", re.MULTILINE)


def in_tree(page: str) -> str:
    """Return the path in the source tree of a page of the site."""
    roots = {place: name for name, place in ROOT_PAGES.items()}
    return roots.get(page, f"docs/{page}")


def place_of(target: str) -> str | None:
    """Return the page of the site that shows this path of the source tree, None if there is none."""
    if target in ROOT_PAGES:
        return ROOT_PAGES[target]
    if target.startswith("docs/"):
        return target.removeprefix("docs/")
    if target.startswith(SCHEMAS) and target.endswith(".json"):
        return f"reference/schemas/{Path(target).stem}.md"
    if (TREE / target).is_file():
        return f"{SOURCES}/{target}.md"
    return None


def targets(page: str, text: str) -> set[str]:
    """Return the paths in the source tree that a page of the site links to."""
    folder = posixpath.dirname(in_tree(page))
    return {posixpath.normpath(posixpath.join(folder, link)) for link in LINK.findall(text)}


def shown(target: str) -> str:
    """Return a page with the text of a file."""
    text = (TREE / target).read_text(encoding="utf-8")
    language = LANGUAGES.get(Path(target).suffix, "text")
    return f"{UNSEARCHED}# {Path(target).name}\n\n`{target}`\n\n````{language}\n{text}\n````\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the files outside docs/."""
    for name, place in ROOT_PAGES.items():
        content = (TREE / name).read_text(encoding="utf-8")
        if name == "CHANGELOG.md":
            content = UNSEARCHED + content
        files.append(File.generated(config, place, content=content))
    for path in sorted((TREE / SCHEMAS).glob("*.json")):
        place = f"reference/schemas/{path.stem}.md"
        files.append(
            File.generated(config, place, content=UNSEARCHED + contracts.schema_page(path))
        )
    wanted: set[str] = set()
    for file in files.documentation_pages():
        wanted |= targets(file.src_uri, file.content_string)
    for target in sorted(wanted):
        if (page := place_of(target)) is not None and page.startswith(f"{SOURCES}/"):
            files.append(File.generated(config, page, content=shown(target)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links into the source tree into links of the site, and marks into generated parts."""
    here = page.file.src_uri
    if here.startswith((f"{SOURCES}/", "reference/schemas/")):
        return markdown
    folder = posixpath.dirname(in_tree(here))

    def moved(link: re.Match[str]) -> str:
        place = place_of(posixpath.normpath(posixpath.join(folder, link[0])))
        return (
            link[0] if place is None else posixpath.relpath(place, posixpath.dirname(here) or ".")
        )

    return MARK.sub(lambda mark: GENERATED[mark[1]](), LINK.sub(moved, markdown))
