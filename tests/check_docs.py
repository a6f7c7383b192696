"""Checks the pages of docs/ for what docs/README.md promises of each shelf.

- A guide begins with what the reader has at its end and how long that takes, and ends with "When it fails".
- Figures that were measured stand under docs/evidence, apart from what a command prints.
- The index and the site list every page.
- A digest beside the name of a shipped policy is that of its file.
"""

import hashlib
import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).parents[1]
DOCS = ROOT / "docs"
GENERATED = "`make reference` writes this page"
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
PROMISE = "At the end of this page"
DURATION = re.compile(r"\b(seconds?|minutes?|hours?)\b")
LAST_HEADING = "When it fails"
DIGEST = re.compile(r"`([\w-]+/\d+)`[^`\n]*`([0-9a-f]{12})`")
MEASURED = re.compile(r"±|\bEPYC\b|\bXeon\b|µs\b|\bmedians? of\b|\bmeasured on\b")


def pages(folder):
    return sorted(DOCS.joinpath(folder).rglob("*.md"))


def complaints_about_guide(text):
    head = text.split("\n## ")[0].split("```")[0]
    if PROMISE not in head:
        yield f"begins without {PROMISE!r}"
    elif not DURATION.search(head):
        yield "begins without how long it takes"
    headings = re.findall(r"^## (.+)$", CODE.sub("", text), re.MULTILINE)
    if not headings or headings[-1] != LAST_HEADING:
        yield f"ends without {LAST_HEADING!r}"


def complaints_about_digests(text):
    for policy, digest in DIGEST.findall(text):
        shipped = (ROOT / "deploy" / "policies" / policy / "policy.safetensors").read_bytes()
        if (expected := hashlib.sha256(shipped).hexdigest()[:12]) != digest:
            yield f"{policy}: expected the digest {expected} of the shipped file, received {digest}"


def main():
    complaints, count = [], 0
    index, site = (DOCS / "README.md").read_text(), (ROOT / "mkdocs.yml").read_text()
    for path in pages("."):
        name, text = path.relative_to(DOCS).as_posix(), path.read_text()
        if name != "README.md" and f"]({name})" not in index:
            complaints.append(f"{name}: docs/README.md does not list it")
        if not re.search(rf"[ \[]{re.escape(name)}\b", site):
            complaints.append(f"{name}: mkdocs.yml does not list it")
        complaints += [f"{name}: {complaint}" for complaint in complaints_about_digests(text)]
        if name.startswith("guides/"):
            complaints += [f"{name}: {complaint}" for complaint in complaints_about_guide(text)]
        if name.startswith("evidence/") or GENERATED in text:
            continue
        count += 1
        for number, line in enumerate(CODE.sub(lambda code: "\n" * code[0].count("\n"), text).splitlines(), 1):
            if found := MEASURED.search(line):
                complaints.append(f"{name}:{number}: {found[0]!r}: measured figures stand under docs/evidence")
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    print(f"check_docs: {count} pages, {len(complaints)} complaints")
    sys.exit(1 if complaints else 0)


if __name__ == "__main__":
    main()
