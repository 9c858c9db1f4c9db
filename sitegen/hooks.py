"""Hooks of MkDocs: generated pages, links into the repository, notebooks, and what a page needs on disk."""

import sys
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.utils import get_relative_url

SHIM = "https://unpkg.com/iframe-worker/shim"
"""Script that Material's plugin `offline` would load."""

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # MkDocs loads this file by its path

from sitegen import markup, mirror, notebooks, pages, reference, tables  # noqa: E402


def on_config(config: Any) -> Any:
    """List the pages of all environments, observers and agents in the navigation, below the page that compares them."""
    (reference,) = (section["Reference"] for section in config.nav if "Reference" in section)
    for row in filter(lambda row: isinstance(row, dict), reference):
        for title, page in row.items():
            if isinstance(page, str) and page in pages.LISTED:
                row[title] = [page, *pages.LISTED[page]()]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add pages that are made from the project, files that others link to, and notebooks."""
    texts = dict(pages.generated())
    for page, text in texts.items():
        files.append(File.generated(config, page, content=text))
    wanted = {
        target
        for file in list(files)
        if file.is_documentation_page() and file.src_uri not in texts
        for target in mirror.links(file.content_string, f"docs/{file.src_uri}")
    }
    for name in pages.mirrored():
        wanted |= set(mirror.links((ROOT / name).read_text(encoding="utf-8"), name))
    wanted |= set(mirror.listed("examples"))
    for target in sorted(wanted):
        page = mirror.page_of(target)
        if page.startswith("files/") and files.get_file_from_path(page) is None:
            files.append(File.generated(config, page, content=mirror.source_page(target)))
    for file in list(files):
        if notebooks.is_tutorial(file.src_uri):
            name = notebooks.name_of(file.src_uri)
            files.append(File.generated(config, name, content=notebooks.notebook(file.content_string)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Fill in the tables of the reference, let links lead to pages of the site, and offer a tutorial as a notebook."""
    uri = page.file.src_uri
    if page.file.generated_by:
        return markdown
    try:
        text = mirror.relinked(reference.filled(markdown), f"docs/{uri}", uri)
    except ValueError as error:
        raise PluginError(f"{uri}: {error}") from None
    if notebooks.is_tutorial(uri):
        name = PurePosixPath(notebooks.name_of(uri)).name
        title, _, rest = text.partition("\n")
        text = f"{title}\n\n[:material-notebook: As a notebook]({name}){{ .md-button download }}\n{rest}"
    return text


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Let paths and pictures be links, and say where lines of titles, tables and code may be broken."""

    def address(path: str) -> str | None:
        found = files.get_file_from_path(mirror.page_of(path))
        return None if found is None or found is page.file else get_relative_url(found.url, page.url)

    html = markup.with_linked_paths(markup.with_linked_pictures(html), address)
    return markup.with_breakable_titles(markup.with_wrapped_code(tables.marked(html)))


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Load what the search needs on disk from the site itself."""
    return output.replace(SHIM, get_relative_url("javascripts/iframe-worker.js", page.url))


def on_post_template(output_content: str, template_name: str, config: Any) -> str:
    """Do the same for 404.html, which also opens from disk."""
    text = output_content.replace(SHIM, "/javascripts/iframe-worker.js")
    return markup.with_own_addresses(text) if template_name == "404.html" else text
