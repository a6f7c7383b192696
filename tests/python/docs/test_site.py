"""`make site` makes a site of docs/ whose links lead somewhere."""

import base64
import hashlib
import html.parser
import os
import pathlib
import subprocess
import urllib.parse

import pytest
from serving import run

ROOT = pathlib.Path(__file__).parents[3]
MKDOCS = ROOT / "build/release-tools/venv/bin/mkdocs"

pytestmark = pytest.mark.skipif(not MKDOCS.exists(), reason="without mkdocs")


def build(folder, configuration=ROOT / "mkdocs.yml"):
    command = [MKDOCS, "build", "--strict", "--config-file", configuration, "--site-dir", folder]
    return run(*command, status=None, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    finished = build(folder)
    assert finished.returncode == 0, finished.stderr
    return folder


class Links(html.parser.HTMLParser):
    """Collects what a page loads and links to, and its anchors."""

    def __init__(self, page):
        super().__init__()
        self.targets, self.loaded, self.anchors = [], [], set()
        self.feed(page.read_text())

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.anchors.add(values.get("id"))
        if tag == "a" and values.get("href"):
            self.targets.append(values["href"])
        if tag in ("img", "script") and values.get("src"):
            self.loaded.append(values["src"])
        if tag == "link" and values.get("rel") == "stylesheet":
            self.loaded.append(values["href"])


class Policies(html.parser.HTMLParser):
    """Collects the Content-Security-Policies of a page, and its scripts and styles without a file."""

    def __init__(self, page):
        super().__init__()
        self.policies, self.inline, self._tag = [], [], None
        self.feed(page.read_text())

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if values.get("http-equiv") == "Content-Security-Policy":
            self.policies.append(values["content"])
        assert not any(name.startswith("on") for name in values), (tag, values)
        if "style" in values:
            self.inline.append(values["style"])
        is_code = tag == "style" or (tag == "script" and "src" not in values and "type" not in values)
        self._tag = tag if is_code else None

    def handle_data(self, data):
        if self._tag is not None:
            self.inline.append(data)

    def handle_endtag(self, tag):
        self._tag = None


def test_every_page_has_a_policy_that_permits_what_is_in_it(site):
    pages = [Policies(page) for page in [*site.rglob("*.html"), ROOT / "client/playground/page/index.html"]]
    assert len(pages) > 20
    for page in pages:
        [policy] = page.policies
        assert policy.startswith("default-src 'none'; script-src 'self'")
        assert "unsafe-inline" not in policy and "'unsafe-eval'" not in policy and "*" not in policy
        for script in page.inline:
            digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
            assert f"'sha256-{digest}'" in policy


def test_every_link_leads_to_a_file_and_a_heading(site):
    pages = {page: Links(page) for page in site.rglob("*.html") if page.name != "404.html"}
    assert len(pages) > 20
    for page, links in pages.items():
        for target in links.targets + links.loaded:
            address = urllib.parse.urlsplit(target)
            if address.scheme or address.netloc:
                continue
            path = page if not address.path else (page.parent / urllib.parse.unquote(address.path)).resolve()
            path = path / "index.html" if path.is_dir() else path
            assert path.is_file(), f"{page}: {target}"
            if address.fragment and path in pages:
                assert urllib.parse.unquote(address.fragment) in pages[path].anchors, f"{page}: {target}"


def test_the_site_loads_nothing_from_other_hosts(site):
    for page in site.rglob("*.html"):
        assert not [address for address in Links(page).loaded if "//" in address]


def test_the_laboratory_is_named_and_not_in_the_site(site):
    assert "<code>lab/" in (site / "evidence/paper/index.html").read_text()
    assert not list(site.glob("source/lab*"))


def test_a_broken_link_fails_the_build(tmp_path):
    """A page that links to nothing, in a copy of the documentation."""
    for name in ("mkdocs.yml", "README.md"):
        (tmp_path / name).write_text((ROOT / name).read_text())
    for name in ("docs", "deploy"):
        subprocess.run(["cp", "-r", ROOT / name, tmp_path / name], check=True)
    page = tmp_path / "docs/guides/site.md"
    page.write_text(page.read_text() + "\n[nothing](nothing.md)\n")
    finished = build(tmp_path / "site", tmp_path / "mkdocs.yml")
    assert finished.returncode != 0
    assert "nothing.md" in finished.stderr
