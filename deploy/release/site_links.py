"""A hook of MkDocs: README.md becomes a page, files outside docs/ to which pages link come along, and pages get a CSP.

A link to such a file leads to its copy below source/ of the site, so that the site has no broken link wherever it is
served. Links to folders, and to the laboratory, become text with the path.
"""

import base64
import hashlib
import posixpath
import re

from mkdocs.structure.files import File

LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
PROJECT = "project.md"
LABORATORY = "lab/"
SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)
STYLE = re.compile(r'<\w+ style="([^"]*)"')  # the columns of a table


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


def _digests(texts):
    digests = {base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts}
    return "".join(f" 'sha256-{digest}'" for digest in sorted(digests))


def _with_policy(output):
    """Adds a Content-Security-Policy: the site's own files, and the scripts and styles that stand in the page itself."""
    scripts, styles = _digests(SCRIPT.findall(output)), _digests(STYLE.findall(output))
    styles = f" 'unsafe-hashes'{styles}" if styles else ""
    policy = (
        f"default-src 'none'; script-src 'self'{scripts}; style-src 'self'{styles}; "
        "img-src 'self' data:; font-src 'self'; connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'"
    )
    return output.replace("<head>", f'<head><meta http-equiv="Content-Security-Policy" content="{policy}">', 1)


def on_post_page(output, page, config):
    """Protects a page."""
    return _with_policy(output)


def on_post_template(output_content, template_name, config):
    """Protects the page of missing pages."""
    return _with_policy(output_content) if template_name.endswith(".html") else output_content
