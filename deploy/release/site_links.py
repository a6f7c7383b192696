"""A hook of MkDocs: README.md becomes a page, and files outside docs/ to which pages link come along.

A link to such a file leads to its copy below source/ of the site, so that the site has no broken link wherever it is
served. Links to folders, and to the laboratory, become text with the path.
"""

import posixpath
import re

from mkdocs.structure.files import File

LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
PROJECT = "project.md"
LABORATORY = "lab/"


def _root(config):
    return posixpath.dirname(config.config_file_path)


def _in_repository(page, target):
    """Returns the path from the root of the repository to which a relative link of a page leads."""
    folder = "" if page == PROJECT else posixpath.join("docs", posixpath.dirname(page))
    return posixpath.normpath(posixpath.join(folder, target))


def _copy_of(path):
    """Returns where the site has a file of the repository. MkDocs would make a page of a name that ends in .md."""
    if path == "README.md":
        return PROJECT
    return f"source/{path}.txt" if path.endswith(".md") else f"source/{path}"


def _is_local(target):
    return not target.startswith(("#", "http://", "https://", "mailto:"))


def _text(page, config):
    if page == PROJECT:
        with open(posixpath.join(_root(config), "README.md"), encoding="utf-8") as file:
            return file.read()
    with open(posixpath.join(config.docs_dir, page), encoding="utf-8") as file:
        return file.read()


def on_files(files, config):
    """Adds the page of README.md, and the files outside docs/ that pages link to."""
    files.append(File.generated(config, PROJECT, content=_text(PROJECT, config)))
    pages = [file.src_uri for file in files.documentation_pages()]
    for page in pages:
        for _, _, target in LINK.findall(_text(page, config)):
            path = _in_repository(page, target.partition("#")[0]) if _is_local(target) else "docs"
            source = posixpath.join(_root(config), path)
            if not path.startswith(("docs", LABORATORY)) and posixpath.isfile(source) and _copy_of(path) not in files.src_uris:
                files.append(File.generated(config, _copy_of(path), abs_src_path=source))
    return files


def on_page_markdown(markdown, page, config, files):
    """Leads links to files outside docs/ to their copies."""

    def lead(link):
        kind, text, target = link.groups()
        name, _, anchor = target.partition("#")
        if not _is_local(target):
            return link[0]
        path = _in_repository(page.file.src_uri, name)
        if path.startswith(LABORATORY):
            return f"`{path}`" if text == path else f"{text} (`{path}`)"
        if path == "docs" or posixpath.isdir(posixpath.join(_root(config), path)):
            return text
        inside = path.removeprefix("docs/") if path.startswith("docs/") else _copy_of(path)
        relative = posixpath.relpath(inside, posixpath.dirname(page.file.src_uri) or ".")
        return f"{kind}[{text}]({relative}{'#' + anchor if anchor and inside.endswith('.md') else ''})"

    return LINK.sub(lead, markdown)
