"""Counts words and phrases that this project overuses, in comments and pages. CHANGELOG.md is history and not read.

A phrase may occur as often as its line allows, because some uses are right: lower the number after mending some.
"--list PHRASE" prints where a phrase stands.
"""

import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[1]
LEFT_OUT = re.compile(r"CHANGELOG\.md|/vendor/|fuzz/corpus|evidence/report/|tests/check_words\.py")
# What a phrase is, what to write instead, and how often it may occur.
PHRASES = {
    "go on": (r"\b(go|goes|going|went) on\b", "continue", 40),
    "is away": (r"\b(is|are|was|be|counts as) away\b(?! from)", "cannot be reached, does not answer", 12),
    "is gone": (r"\b(is|are|was) gone\b", "has ended, no longer exists", 20),
    "comes back": (r"\b(come|comes|came) back\b", "answers again, returns", 12),
    "in vain": (r"\bin vain\b", "without an answer, without success", 4),
    "what it is": (r"\bwhat (it|they) (is|are|has|have)\b", "name the thing", 35),
    "says": (r"\b(says|say|said)\b", "shows, has, names, reports: things do not talk", 160),
    "tells": (r"\b(tells|tell|(?<!be )told)\b", "shows, has, reports: things do not talk", 95),
    "calls itself": (r"\bcalls? (it|them)sel(f|ves)\b", "its name", 4),
    "became of": (r"\b(became|becomes) of\b", "its outcome", 4),
    "wants": (r"\bwants?\b", "needs, requires, asks for", 15),
    "hears": (r"\b(hear|hears|heard)\b", "receives, watches", 5),
}
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
COMMENTS = {
    ".md": None,
    ".py": re.compile(r'"""(.*?)"""|(#[^\n]*)', re.DOTALL),
    ".sh": re.compile(r"^\s*(#[^\n]*)", re.MULTILINE),
    **dict.fromkeys((".h", ".cc", ".js", ".proto"), re.compile(r"(//[^\n]*)|/\*(.*?)\*/", re.DOTALL)),
}


def prose_of(path):
    """Returns the text of a file with everything but its comments blanked, so that lines keep their numbers."""
    text, pattern = path.read_text(encoding="utf-8"), COMMENTS[path.suffix]
    if pattern is None:
        return CODE.sub(lambda code: "\n" * code[0].count("\n"), text)
    kept, end = [], 0
    for comment in pattern.finditer(text):
        kept += ["\n" * text.count("\n", end, comment.start()), comment[0]]
        end = comment.end()
    return "".join(kept)


def main():
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    found = {phrase: [] for phrase in PHRASES}
    for name in names.split("\0"):
        path = ROOT / name
        if path.suffix not in COMMENTS or LEFT_OUT.search(name) or not path.is_file():
            continue
        text = prose_of(path)
        for phrase, (pattern, _, _) in PHRASES.items():
            for match in re.finditer(pattern, text, re.IGNORECASE):
                found[phrase].append(f"{name}:{text.count(chr(10), 0, match.start()) + 1}")
    if sys.argv[1:2] == ["--list"]:
        print("\n".join(found[sys.argv[2]]))
        return
    failed = False
    for phrase, (_, instead, most) in PHRASES.items():
        count = len(found[phrase])
        print(f"{phrase:14} {count:4}  (at most {most})")
        if count > most:
            failed = True
            print(f"  FAILED: {phrase!r}: expected at most {most}, received {count}; write: {instead}", file=sys.stderr)
    sys.exit(failed)


if __name__ == "__main__":
    main()
