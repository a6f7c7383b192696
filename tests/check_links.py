"""Checks that every relative link of the tree's Markdown pages leads to a file or a folder that git tracks."""

import os
import re
import subprocess
import sys

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
LINK = re.compile(r"\]\(([^)\s]+)\)")


def tracked(*patterns):
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *patterns]
    names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [name for name in names.split("\0") if name]


def main():
    files = set(tracked())
    known = files | {os.path.dirname(name) for name in files}
    known |= {folder[:i] for folder in known for i, character in enumerate(folder) if character == "/"}
    complaints, links = [], 0
    for page in tracked("*.md"):
        with open(os.path.join(ROOT, page), encoding="utf-8") as file:
            text = file.read()
        for link in LINK.findall(text):
            path = link.partition("#")[0]
            if "://" in link or not path:
                continue
            links += 1
            if os.path.normpath(os.path.join(os.path.dirname(page), path)) not in known:
                complaints.append(f"{page}: {link} leads nowhere")
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_links: {links} links, {len(complaints)} complaints")
    sys.exit(1 if complaints else 0)


if __name__ == "__main__":
    main()
