"""Checks the links of the tree's Markdown pages.

Each relative link leads to a file or a folder that git tracks, and to a heading that the page has. Every page of docs/ is at
most two clicks away from docs/README.md.
"""

import os
import re
import subprocess
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
INDEX = "docs/README.md"
CLICKS = 2
LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def tracked(*patterns):
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *patterns]
    names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [name for name in names.split("\0") if name and os.path.exists(os.path.join(ROOT, name))]


def anchor_of(heading):
    """Returns the anchor that GitHub gives to a heading."""
    text = LINK.sub("]", heading).lower()
    return re.sub(r"[^\w\- ]", "", text).strip().replace(" ", "-")


def anchors_of(text):
    found = {}
    for heading in HEADING.findall(CODE.sub("", text)):
        anchor = anchor_of(heading)
        found[anchor] = found.get(anchor, -1) + 1
    return {anchor if not i else f"{anchor}-{i}" for anchor, count in found.items() for i in range(count + 1)}


def pages_within(clicks, links):
    """Returns the pages that `clicks` clicks from the index reach. `links` has the pages to which each page links."""
    reached = {INDEX}
    for _ in range(clicks):
        reached |= {target for page in reached for target in links.get(page, ())}
    return reached


def main():
    files = set(tracked())
    known = files | {os.path.dirname(name) for name in files}
    known |= {folder[:i] for folder in known for i, character in enumerate(folder) if character == "/"}
    texts = {}
    for page in tracked("*.md"):
        with open(os.path.join(ROOT, page), encoding="utf-8") as file:
            texts[page] = file.read()
    anchors = {page: anchors_of(text) for page, text in texts.items()}
    complaints, count, links = [], 0, {}
    for page, text in texts.items():
        for link in LINK.findall(text):
            path, _, anchor = link.partition("#")
            if "://" in link or link.startswith("mailto:"):
                continue
            count += 1
            target = os.path.normpath(os.path.join(os.path.dirname(page), path)) if path else page
            links.setdefault(page, set()).add(target)
            if target not in known:
                complaints.append(f"{page}: {link} leads nowhere")
            elif anchor and target in anchors and anchor not in anchors[target]:
                complaints.append(f"{page}: {link}: {target} has no such heading")
    reached = pages_within(CLICKS, links)
    for page in sorted(texts):
        if page.startswith("docs/") and page not in reached:
            complaints.append(f"{page}: more than {CLICKS} clicks away from {INDEX}")
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_links: {count} links, {len(complaints)} complaints")
    sys.exit(1 if complaints else 0)


if __name__ == "__main__":
    main()
